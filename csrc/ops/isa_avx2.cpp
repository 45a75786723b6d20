// The kernels compiled for avx2. Only C headers here: a std:: template instantiated with these flags could
// be the copy that the linker keeps for everyone.
#include <math.h>
#include <stddef.h>
#include <stdint.h>
#if defined(__x86_64__)
#include <immintrin.h>
#endif
#include "../math/blend.h"
#include "dispatch.h"

#define LANES 8
namespace refdgs {
namespace avx2 {
namespace {
#include "simd.h"
#include "image_loss.inl"
#include "mlp.inl"
#include "rasterize.inl"
#include "shade.inl"
#include "photo.inl"
#include "sph_mip.inl"
}  // namespace
extern const Kernels kernels;
const Kernels kernels = {"avx2", LANES, raster_kernels<float>, loss_band<float>, sph_mip_kernels<float>(),
                         mlp_kernels<float>(), shade_kernels<float>(),
                         photo_kernels<float>()};
}  // namespace avx2
}  // namespace refdgs
