#include "queue.cuh"
#include "raster_tiles.inl"

namespace refdgs::cuda {
REFDGS_TILES(float, DeviceQueue, 4)
}
