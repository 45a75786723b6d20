#include "queue.cuh"
#include "raster.inl"

namespace refdgs::cuda {
REFDGS_RASTER(float, DeviceQueue)
template int64_t sort_scratch<DeviceQueue>(const DeviceQueue&, int64_t);
}  // namespace refdgs::cuda
