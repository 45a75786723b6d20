// Memory aligned to a cache line, zero at first.
#pragma once
#include <cstdint>
#include <vector>

namespace refdgs {

template <class S> struct Buffer {
  std::vector<S> memory;
  S* data = nullptr;
  void make(int64_t size) {
    memory.assign(size_t(size) + 64 / sizeof(S), S(0));
    data = reinterpret_cast<S*>((reinterpret_cast<uintptr_t>(memory.data()) + 63) / 64 * 64);
  }
};

}  // namespace refdgs
