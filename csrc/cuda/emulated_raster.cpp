#include "emulated.h"
#include "raster.inl"
#include "raster_tiles.inl"

namespace refdgs::cuda {

#define REFDGS_EMULATED(S)               \
  REFDGS_RASTER(S, EmulatedQueue)        \
  REFDGS_TILES(S, EmulatedQueue, 4)      \
  REFDGS_TILES(S, EmulatedQueue, 8)      \
  REFDGS_TILES(S, EmulatedQueue, 12)     \
  REFDGS_TILES(S, EmulatedQueue, 16)     \
  REFDGS_TILES(S, EmulatedQueue, 20)
REFDGS_EMULATED(float)
REFDGS_EMULATED(double)

}  // namespace refdgs::cuda
