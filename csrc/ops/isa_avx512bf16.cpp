// The network's products of bfloat16 numbers. Only C headers here, as in isa_avx512.cpp.
#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <immintrin.h>
#include "dispatch.h"

#define LANES 16
namespace refdgs {
namespace avx512bf16 {
namespace {
#include "simd.h"
#include "mlp.inl"
#include "mlp_half.inl"
}  // namespace
extern const MlpKernels<float> mlp;
const MlpKernels<float> mlp = {half_forward, half_backward};
}  // namespace avx512bf16
}  // namespace refdgs
