#include "queue.cuh"
#include "mlp.inl"

namespace refdgs::cuda {
REFDGS_MLP(float, DeviceQueue)
}
