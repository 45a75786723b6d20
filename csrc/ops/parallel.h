// Loops over the cores. The number of threads is always an argument, so that it follows torch's.
#pragma once
#include <cstdint>

#if defined(_OPENMP)
#include <omp.h>
#endif

namespace refdgs {

template <class F> void parallel_for(int64_t n, [[maybe_unused]] int threads, F&& body) {
#if defined(_OPENMP)
#pragma omp parallel for num_threads(threads) schedule(static) if (threads > 1)
#endif
  for (int64_t i = 0; i < n; ++i) body(i);
}

// For items of uneven cost; the body also learns which thread it is on, to use that thread's scratch.
template <class F> void parallel_for_dynamic(int64_t n, [[maybe_unused]] int threads, F&& body) {
#if defined(_OPENMP)
#pragma omp parallel for num_threads(threads) schedule(dynamic) if (threads > 1)
  for (int64_t i = 0; i < n; ++i) body(i, omp_get_thread_num());
#else
  for (int64_t i = 0; i < n; ++i) body(i, 0);
#endif
}

}  // namespace refdgs
