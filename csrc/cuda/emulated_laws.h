// Kernels that show what the emulated grid notices, for tests of the grid itself.
#pragma once
#include <nanobind/nanobind.h>
#include <nanobind/stl/vector.h>

#include <utility>
#include <vector>

#include "emulated.h"

namespace refdgs::cuda {

// Lane k ends with the sum over lanes of 100 lane + k, k < N; out[N - 1] becomes the largest error.
template <int N> struct AddLanes {
  static constexpr int kThreads = kWarp;
  using Shared = Nothing;
  double* out;
  template <class Thread> void operator()(Thread& t, Shared&) const {
    double v[N];
    for (int k = 0; k < N; ++k) v[k] = 100 * t.lane() + k;
    const double sum = sum_lanes<N>(t, v), wanted = 100 * 496 + 32 * t.lane();
    if (t.lane() < N && std::fabs(sum - wanted) > out[N - 1]) out[N - 1] = std::fabs(sum - wanted);
  }
};

// Every thread reads what the next one wrote, with or without a barrier between.
struct ReadNeighbour {
  static constexpr int kThreads = 64;
  struct Shared {
    int value[kThreads];
  };
  bool waits;
  int* wrong;
  template <class Thread> void operator()(Thread& t, Shared& s) const {
    s.value[t.thread()] = t.thread();
    if (waits) t.sync();
    const int next = (t.thread() + 1) % kThreads;
    if (s.value[next] != next) ++*wrong;
  }
};

// One thread goes without the others' barrier.
struct LeaveEarly {
  static constexpr int kThreads = 64;
  using Shared = Nothing;
  template <class Thread> void operator()(Thread& t, Shared&) const {
    if (t.thread() != 5) t.sync();
  }
};

template <int... N> std::vector<double> lane_errors(std::integer_sequence<int, N...>) {
  std::vector<double> out(sizeof...(N), 0.0);
  (EmulatedQueue{nullptr}.run(1, AddLanes<N + 1>{out.data()}), ...);
  return out;
}

inline void bind_laws(nanobind::module_& m) {
  m.def("lane_errors", [] { return lane_errors(std::make_integer_sequence<int, kWarp>()); });
  m.def("wrong_neighbours", [](uintptr_t order, bool waits) {
    int wrong = 0;
    EmulatedQueue{reinterpret_cast<void*>(order)}.run(1, ReadNeighbour{waits, &wrong});
    return wrong;
  });
  m.def("launches", [] { return launches; });
  m.def("leave_early", [] { EmulatedQueue{nullptr}.run(1, LeaveEarly{}); });
}

}  // namespace refdgs::cuda
