#include "dispatch.h"

#include <cstdlib>
#include <cstring>

namespace refdgs {

namespace baseline {
extern const Kernels kernels;
}
#if defined(REFDGS_X86)
namespace avx2 {
extern const Kernels kernels;
}
namespace avx512 {
extern const Kernels kernels;
}
#endif
#if defined(REFDGS_BF16)
namespace avx512bf16 {
extern const MlpKernels<float> mlp;
}
#endif

const Kernels& kernels() {
  static const Kernels& chosen = []() -> const Kernels& {
#if defined(REFDGS_X86)
    const char* cap = std::getenv("REFDGS_ISA");
    __builtin_cpu_init();
    const bool v3 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
    const bool v4 = v3 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512vl") &&
                    __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512bw");
    if (v4 && (!cap || !std::strncmp(cap, "avx512", 6))) return avx512::kernels;
    if (v3 && (!cap || std::strcmp(cap, "baseline"))) return avx2::kernels;
#endif
    return baseline::kernels;
  }();
  return chosen;
}

const MlpKernels<float>* half_products() {
#if defined(REFDGS_BF16)
  static const bool has = [] {
    const char* cap = std::getenv("REFDGS_ISA");
    return !std::strcmp(kernels().name, "avx512") && __builtin_cpu_supports("avx512bf16") &&
           (!cap || !std::strcmp(cap, "avx512bf16"));
  }();
  return has ? &avx512bf16::mlp : nullptr;
#else
  return nullptr;
#endif
}

}  // namespace refdgs
