#include "queue.cuh"
#include "photo.inl"

namespace refdgs::cuda {
REFDGS_PHOTO(float, DeviceQueue)
}
