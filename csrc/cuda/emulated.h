// The grid of grid.h on the CPU: each thread of a block is a fiber with its own stack, and waits where a GPU's
// thread would. For tests; slow.
#pragma once
#include <csetjmp>
#include <cstring>
#include <memory>
#include <random>
#include <vector>

#include <ucontext.h>

#include "grid.h"
#include "queue.h"

namespace refdgs::cuda {

// One block's threads. A block whose threads do not all come to a barrier throws.
class Fibers {
 public:
  Fibers(int threads, unsigned order);
  // Runs body(thread) in every fiber to its end.
  template <class F> void run(F&& body) {
    start([](void* f, int thread) { (*static_cast<std::remove_reference_t<F>*>(f))(thread); }, &body);
  }

  void barrier() { wait(block_, threads_); }
  void barrier_warp(int warp) { wait(warps_[size_t(warp)].gate, kWarp); }
  // Every lane leaves a value and reads the others' after all have come. Two sets of slots: a lane can be one
  // exchange ahead of another, not two.
  template <class V> V exchange(int thread, V value, int from) {
    static_assert(sizeof(V) <= 8, "a register");
    Warp& w = warps_[size_t(thread / kWarp)];
    char* slots = w.slots[w.gate.turn & 1];
    std::memcpy(slots + 8 * (thread % kWarp), &value, sizeof value);
    wait(w.gate, kWarp);
    V out;
    std::memcpy(&out, slots + 8 * from, sizeof out);
    return out;
  }
  uint32_t ballot(int thread, bool p);
  // The numbers that every lane of the warp brings, in the order of lanes.
  template <class V> const V* gather(int thread, const V& mine) {
    static_assert(sizeof(V) <= kBrought, "as much as a lane may bring");
    Warp& w = warps_[size_t(thread / kWarp)];
    char* brought = w.brought[w.gate.turn & 1];
    std::memcpy(brought + sizeof(V) * (thread % kWarp), &mine, sizeof mine);
    wait(w.gate, kWarp);
    return reinterpret_cast<const V*>(brought);
  }

 private:
  static constexpr size_t kBrought = 128;
  struct Gate {
    int come = 0;
    unsigned turn = 0;
  };
  struct Warp {
    Gate gate;
    char slots[2][8 * kWarp];
    alignas(16) char brought[2][kBrought * kWarp];
  };
  struct Fiber {
    ucontext_t entry;
    jmp_buf at;
    std::unique_ptr<char[]> stack;
    bool begun, done;
  };
  void start(void (*body)(void*, int), void* argument);
  void wait(Gate& gate, int all);
  void yield();
  void resume(int thread);
  static void enter(unsigned high, unsigned low);

  int threads_, current_ = 0;
  bool moved_ = false;
  std::vector<Fiber> fibers_;
  std::vector<int> turns_;
  std::vector<Warp> warps_;
  Gate block_;
  jmp_buf home_;
  void (*body_)(void*, int) = nullptr;
  void* argument_ = nullptr;
};

struct EmulatedThread {
  int block_, thread_;
  Fibers* fibers;
  int block() const { return block_; }
  int thread() const { return thread_; }
  int lane() const { return thread_ % kWarp; }
  int warp() const { return thread_ / kWarp; }
  void sync() { fibers->barrier(); }
  void sync_warp() { fibers->barrier_warp(warp()); }
  template <class V> V shuffle(V v, int lane) { return fibers->exchange(thread_, v, lane); }
  template <class V> V shuffle_xor(V v, int mask) { return fibers->exchange(thread_, v, lane() ^ mask); }
  uint32_t ballot(bool p) { return fibers->ballot(thread_, p); }
  bool any(bool p) { return ballot(p) != 0; }
  // To nearest with 10 bits after the first, ties away from 0. A double stays as it is: it proves who has what.
  static double tf32(double x) { return x; }
  static float tf32(float x) {
    uint32_t bits;
    std::memcpy(&bits, &x, 4);
    bits = (bits + 0x1000u) & ~0x1fffu;
    std::memcpy(&x, &bits, 4);
    return x;
  }
  // By the table in PTX ISA, mma.m16n8k8 for .tf32.
  template <class S> void mma(S* c, const S* a, const S* b) {
    struct Brought {
      S a[4], b[2];
    };
    const Brought* all = fibers->gather(thread_, Brought{{a[0], a[1], a[2], a[3]}, {b[0], b[1]}});
    for (int i = 0; i < 4; ++i) {
      const int row = lane() / 4 + (i >= 2 ? 8 : 0), column = 2 * (lane() % 4) + (i & 1);
      for (int k = 0; k < 8; ++k) {
        const S left = all[row % 8 * 4 + k % 4].a[(row >= 8 ? 1 : 0) + (k >= 4 ? 2 : 0)];
        c[i] += left * all[column * 4 + k % 4].b[k / 4];
      }
    }
  }
  static uint16_t half(float x) {  // to the nearest, ties to even
    uint32_t bits;
    std::memcpy(&bits, &x, 4);
    if ((bits & 0x7fffffffu) > 0x7f800000u) return uint16_t(bits >> 16 | 0x40u);
    return uint16_t((bits + 0x7fffu + (bits >> 16 & 1u)) >> 16);
  }
  static double half(double x) { return x; }
  static float whole(uint16_t x) {
    const uint32_t bits = uint32_t(x) << 16;
    float out;
    std::memcpy(&out, &bits, 4);
    return out;
  }
  static double whole(double x) { return x; }
  static uint32_t pair(float a, float b) { return uint32_t(half(a)) | uint32_t(half(b)) << 16; }
  static Halved<double>::Pair pair(double a, double b) { return {{a, b}}; }
  static float first(uint32_t p) { return whole(uint16_t(p)); }
  static float second(uint32_t p) { return whole(uint16_t(p >> 16)); }
  static double first(const Halved<double>::Pair& p) { return p.v[0]; }
  static double second(const Halved<double>::Pair& p) { return p.v[1]; }
  template <class P> static P where_positive(const P& h, const P& p) {
    return pair(first(h) > 0 ? first(p) : 0 * first(h), second(h) > 0 ? second(p) : 0 * second(h));
  }
  static void put_pair(uint16_t* at, uint32_t p) {
    if (reinterpret_cast<uintptr_t>(at) % 4) std::abort();
    at[0] = uint16_t(p), at[1] = uint16_t(p >> 16);
  }
  static void put_pair(double* at, const Halved<double>::Pair& p) { at[0] = p.v[0], at[1] = p.v[1]; }
  // By the table in PTX ISA, mma.m16n8k16 for .bf16.
  template <class S, class P> void mma_half(S* c, const P* a, const P* b) {
    struct Brought {
      P a[4], b[2];
    };
    const Brought* all = fibers->gather(thread_, Brought{{a[0], a[1], a[2], a[3]}, {b[0], b[1]}});
    for (int i = 0; i < 4; ++i) {
      const int row = lane() / 4 + (i >= 2 ? 8 : 0), column = 2 * (lane() % 4) + (i & 1);
      for (int k = 0; k < 16; ++k) {
        const P& left = all[row % 8 * 4 + k % 8 / 2].a[(row >= 8 ? 1 : 0) + (k >= 8 ? 2 : 0)];
        const P& right = all[column * 4 + k % 8 / 2].b[k / 8];
        c[i] += (k % 2 ? second(left) : first(left)) * (k % 2 ? second(right) : first(right));
      }
    }
  }
  // PTX ISA, ldmatrix.m8n8.x4.
  template <bool Turned, class P, class One> void load_pairs(P* r, const One* row) {
    if (reinterpret_cast<uintptr_t>(row) % 16) std::abort();
    const One* const* all = fibers->gather(thread_, row);
    const int group = lane() / 4, quarter = lane() % 4;
    for (int m = 0; m < 4; ++m) {
      const One* const* rows = all + 8 * m;
      r[m] = Turned ? pair(whole(rows[2 * quarter][group]), whole(rows[2 * quarter + 1][group]))
                    : pair(whole(rows[group][2 * quarter]), whole(rows[group][2 * quarter + 1]));
    }
  }
  void add_bits(int64_t* p, int64_t v) { *p = int64_t(uint64_t(*p) + uint64_t(v)); }
  int64_t fetch_add(int64_t* p, int64_t v) {
    const int64_t before = *p;
    add_bits(p, v);
    return before;
  }
  void raise_bits(uint32_t* p, uint32_t v) { *p = *p < v ? v : *p; }
};

// How much work was put on emulated queues: kernels, clears, scans and sorts.
inline int64_t launches = 0;

// Shared memory starts as garbage, as on a GPU.
template <class K> void EmulatedQueue::run(int64_t blocks, const K& kernel) const {
  if (!blocks) return;
  ++launches;
  Fibers fibers(K::kThreads, unsigned(reinterpret_cast<uintptr_t>(order)));
  auto shared = std::make_unique<typename K::Shared>();
  for (int64_t block = 0; block < blocks; ++block) {
    std::memset(static_cast<void*>(shared.get()), 0xa5, sizeof *shared);
    fibers.run([&](int thread) {
      EmulatedThread t{int(block), thread, &fibers};
      kernel(t, *shared);
    });
  }
}

}  // namespace refdgs::cuda
