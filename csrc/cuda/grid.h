// The grid that kernels run on. A kernel is a struct: its arguments, `kThreads`, a `Shared` and
//     template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared& s) const
// that is the body of one thread. nvcc runs it on the GPU (queue.cuh), g++ on an emulated grid (emulated.h):
// the same text, the same index arithmetic, barriers and exchanges between lanes.
//
// Thread: block(), thread(), lane(), warp(); sync() of the block, sync_warp(); shuffle(v, lane) and
// shuffle_xor(v, mask), ballot(p), any(p) of the warp; add_bits(p, v) and raise_bits(p, v), atomic on integers,
// so that no result depends on an order, and fetch_add(p, v), whose answer does: what it orders must be sorted. Every
// lane of a warp must reach every exchange.
#pragma once
#include <cstdint>
#include <cstdlib>

#include "../math/vec.h"

#if defined(__CUDACC__)
#define REFDGS_KERNEL __device__ inline
#else
#define REFDGS_KERNEL inline
#endif

namespace refdgs::cuda {

constexpr int kWarp = 32;

struct Nothing {};  // a kernel that shares nothing

inline int64_t blocks_for(int64_t items, int each) { return (items + each - 1) / each; }

#if defined(__CUDACC__)
REFDGS_KERNEL int lowest_bit(uint32_t x) { return __ffs(int(x)) - 1; }
REFDGS_KERNEL int bit_count(uint32_t x) { return __popc(x); }
#else
REFDGS_KERNEL int lowest_bit(uint32_t x) { return __builtin_ctz(x); }
REFDGS_KERNEL int bit_count(uint32_t x) { return __builtin_popcount(x); }
#endif

// Four scalars at a time, where memory is aligned to that: a GPU faults where it is not, so the emulated grid stops.
template <class S> struct alignas(4 * sizeof(S)) Quad {
  S v[4];
};
#if defined(__CUDACC__)
REFDGS_KERNEL void check_quad(const void*, size_t) {}
#else
inline void check_quad(const void* at, size_t bytes) {
  if (reinterpret_cast<uintptr_t>(at) % bytes) std::abort();
}
#endif
template <int N, class S> REFDGS_KERNEL void copy_quads(S* to, const S* from) {
  static_assert(N % 4 == 0, "quads");
  check_quad(from, sizeof(Quad<S>));
  for (int i = 0; i < N; i += 4) {
    const Quad<S> q = *reinterpret_cast<const Quad<S>*>(from + i);
    for (int k = 0; k < 4; ++k) to[i + k] = q.v[k];
  }
}
template <class S> REFDGS_KERNEL void put_quad(S* to, const S* v) {
  check_quad(to, sizeof(Quad<S>));
  *reinterpret_cast<Quad<S>*>(to) = {{v[0], v[1], v[2], v[3]}};
}

// The sums over a warp's lanes of v[0..N-1], N <= 32: lane k ends with sum k. Halves of the warp exchange halves
// of the values: 16 + 8 + 4 + 2 + 1 exchanges at most, where one sum after the other takes 5 N.
template <int N, class S, class Thread> REFDGS_KERNEL S sum_lanes(Thread& t, S* v) {
  static_assert(N >= 1 && N <= kWarp, "one sum a lane");
#if defined(__CUDACC__)
#pragma unroll
#endif
  for (int half = kWarp / 2; half > 0; half /= 2) {
    if (half >= N) continue;
    const bool upper = t.lane() & half;
#if defined(__CUDACC__)
#pragma unroll
#endif
    for (int k = 0; k < kWarp / 2; ++k) {
      if (k >= half) continue;
      if (k + half < N) {
        const S give = upper ? v[k] : v[k + half], mine = upper ? v[k + half] : v[k];
        v[k] = mine + t.shuffle_xor(give, half);
      } else {
        v[k] += t.shuffle_xor(v[k], half);
      }
    }
  }
  for (int half = kWarp / 2; half > 0; half /= 2)
    if (half >= N) v[0] += t.shuffle_xor(v[0], half);
  return v[0];
}

}  // namespace refdgs::cuda
