#include "queue.cuh"
#include "adam.inl"

namespace refdgs::cuda {
REFDGS_ADAM(float, DeviceQueue)
}
