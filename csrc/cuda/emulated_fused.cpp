#include "emulated.h"
#include "adam.inl"
#include "elementwise.inl"
#include "image_loss.inl"
#include "mlp.inl"
#include "photo.inl"
#include "shade.inl"
#include "sph_mip.inl"

namespace refdgs::cuda {

#define REFDGS_EMULATED(S)              \
  REFDGS_ADAM(S, EmulatedQueue)         \
  REFDGS_ELEMENTWISE(S, EmulatedQueue)  \
  REFDGS_IMAGE_LOSS(S, EmulatedQueue)   \
  REFDGS_MLP(S, EmulatedQueue)          \
  REFDGS_PHOTO(S, EmulatedQueue)        \
  REFDGS_SHADE(S, EmulatedQueue)        \
  REFDGS_SPH_MIP(S, EmulatedQueue)
REFDGS_EMULATED(float)
REFDGS_EMULATED(double)

}  // namespace refdgs::cuda
