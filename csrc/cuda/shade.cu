#include "queue.cuh"
#include "shade.inl"

namespace refdgs::cuda {
REFDGS_SHADE(float, DeviceQueue)
}
