// Clearing and scanning on a GPU; the latter is CUB's.
#include <cub/device/device_scan.cuh>

#include "queue.cuh"

namespace refdgs::cuda {

void DeviceQueue::zero(void* at, size_t bytes) const {
  if (bytes) check(cudaMemsetAsync(at, 0, bytes, static_cast<cudaStream_t>(stream)), "memset");
}

size_t DeviceQueue::scan_bytes(int64_t count) const {
  size_t bytes = 0;
  int64_t* none = nullptr;
  check(cub::DeviceScan::ExclusiveSum(nullptr, bytes, none, none, count), "size of scan");
  return bytes;
}

void DeviceQueue::scan(int64_t* values, int64_t count, void* scratch, size_t bytes) const {
  const auto s = static_cast<cudaStream_t>(stream);
  check(cub::DeviceScan::ExclusiveSum(scratch, bytes, values, values, count, s), "scan");
}

}  // namespace refdgs::cuda
