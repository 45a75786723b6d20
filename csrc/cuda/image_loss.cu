#include "queue.cuh"
#include "image_loss.inl"

namespace refdgs::cuda {
REFDGS_IMAGE_LOSS(float, DeviceQueue)
}
