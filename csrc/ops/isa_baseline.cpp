// The kernels compiled for baseline. Only C headers here: a std:: template instantiated with these flags could
// be the copy that the linker keeps for everyone.
#include <math.h>
#include <stddef.h>
#include <stdint.h>
#if defined(__x86_64__)
#include <immintrin.h>
#endif
#include "../math/blend.h"
#include "dispatch.h"

#define LANES 4
namespace refdgs {
namespace baseline {
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
const Kernels kernels = {"baseline", LANES, raster_kernels<float>, loss_band<float>, sph_mip_kernels<float>(),
                         mlp_kernels<float>(), shade_kernels<float>(),
                         photo_kernels<float>()};
}  // namespace baseline
RasterKernels<double> raster_kernels_double(int channels, Extra extra) {
  return baseline::raster_kernels<double>(channels, extra);
}
void loss_band_double(const LossFrame<double>& frame, int channel, int band, double* scratch, double* sums) {
  baseline::loss_band(frame, channel, band, scratch, sums);
}
SphMipKernels<double> sph_mip_kernels_double() { return baseline::sph_mip_kernels<double>(); }
MlpKernels<double> mlp_kernels_double() { return baseline::mlp_kernels<double>(); }
const ShadeKernels<double>& shade_kernels_double() {
  static const ShadeKernels<double> kernels = baseline::shade_kernels<double>();
  return kernels;
}
const PhotoKernels<double>& photo_kernels_double() {
  static const PhotoKernels<double> kernels = baseline::photo_kernels<double>();
  return kernels;
}
}  // namespace refdgs
