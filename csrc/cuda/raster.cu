#include "queue.cuh"
#include "raster.inl"

namespace refdgs::cuda {
REFDGS_RASTER(float, DeviceQueue)
}  // namespace refdgs::cuda
