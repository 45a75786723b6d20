#include "queue.cuh"
#include "sph_mip.inl"

namespace refdgs::cuda {
REFDGS_SPH_MIP(float, DeviceQueue)
}
