// What a pipeline of kernels is put on: the stream of a GPU, or the emulated grid.
#pragma once
#include <cstddef>
#include <cstdint>

namespace refdgs::cuda {

// `run` launches a kernel of grid.h. `scan`: exclusive sums in place, with scratch as large as scan_bytes says.
struct DeviceQueue {
  void* stream;
  template <class K> void run(int64_t blocks, const K& kernel) const;
  void zero(void* at, size_t bytes) const;
  size_t scan_bytes(int64_t count) const;
  void scan(int64_t* values, int64_t count, void* scratch, size_t bytes) const;
};

// The same, on the CPU. order: threads of a block take turns first to last, last to first, or (2 and up) at
// random with that seed: a result that depends on it shows a missing barrier.
struct EmulatedQueue {
  void* order;
  template <class K> void run(int64_t blocks, const K& kernel) const;
  void zero(void* at, size_t bytes) const;
  size_t scan_bytes(int64_t) const { return 8; }
  void scan(int64_t* values, int64_t count, void* scratch, size_t bytes) const;
};

}  // namespace refdgs::cuda
