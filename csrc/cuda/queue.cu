// Clearing, scanning and sorting on a GPU; the last two are CUB's.
#include <cub/device/device_radix_sort.cuh>
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

size_t DeviceQueue::sort_bytes(int64_t count) const {
  size_t bytes = 0;
  cub::DoubleBuffer<uint64_t> keys(nullptr, nullptr);
  cub::DoubleBuffer<int32_t> values(nullptr, nullptr);
  check(cub::DeviceRadixSort::SortPairs(nullptr, bytes, keys, values, int32_t(count)), "size of sort");
  return bytes;
}

SortedPairs DeviceQueue::sort(SortedPairs pairs, SortedPairs spare, int64_t count, int bits, void* scratch,
                              size_t bytes) const {
  cub::DoubleBuffer<uint64_t> keys(pairs.keys, spare.keys);
  cub::DoubleBuffer<int32_t> values(pairs.values, spare.values);
  const auto s = static_cast<cudaStream_t>(stream);
  if (count)
    check(cub::DeviceRadixSort::SortPairs(scratch, bytes, keys, values, int32_t(count), 0, bits, s), "sort");
  return {keys.Current(), values.Current()};
}

}  // namespace refdgs::cuda
