// The kernels of the best instruction set this CPU has, chosen once.
#pragma once
#include "image_loss.h"
#include "mlp.h"
#include "photo.h"
#include "raster.h"
#include "shade.h"
#include "sph_mip.h"

namespace refdgs {

// Every instruction set fills one of these; see isa_*.cpp.
struct Kernels {
  const char* name;
  int lanes;
  RasterKernels<float> (*raster)(int channels, Extra extra);
  LossKernel<float> loss_band;
  SphMipKernels<float> sph_mip;
  MlpKernels<float> mlp;
  ShadeKernels<float> shade;
  PhotoKernels<float> photo;
};

// REFDGS_ISA=baseline|avx2|avx512|avx512bf16 caps the choice, for tests.
const Kernels& kernels();

// The network with products of bfloat16 numbers; null where the CPU has none.
const MlpKernels<float>* half_products();

// Double precision exists once, portable: it proves gradients, it is not fast.
RasterKernels<double> raster_kernels_double(int channels, Extra extra);
void loss_band_double(const LossFrame<double>& frame, int channel, int band, double* scratch, double* sums);
SphMipKernels<double> sph_mip_kernels_double();
MlpKernels<double> mlp_kernels_double();
const ShadeKernels<double>& shade_kernels_double();
const PhotoKernels<double>& photo_kernels_double();

}  // namespace refdgs
