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

const Kernels& kernels() {
  static const Kernels& chosen = []() -> const Kernels& {
#if defined(REFDGS_X86)
    const char* cap = std::getenv("REFDGS_ISA");
    __builtin_cpu_init();
    const bool v3 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
    const bool v4 = v3 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512vl") &&
                    __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512bw");
    if (v4 && (!cap || !std::strcmp(cap, "avx512"))) return avx512::kernels;
    if (v3 && (!cap || std::strcmp(cap, "baseline"))) return avx2::kernels;
#endif
    return baseline::kernels;
  }();
  return chosen;
}

}  // namespace refdgs
