#include "queue.cuh"
#include "elementwise.inl"

namespace refdgs::cuda {
REFDGS_ELEMENTWISE(float, DeviceQueue)
}
