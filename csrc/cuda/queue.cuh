// Kernels on a GPU: one launch each, on the caller's stream. Nothing is allocated and nothing waits.
#pragma once
#include <cuda_runtime.h>

#include <stdexcept>
#include <string>
#include <type_traits>
#include <typeinfo>

#include "grid.h"
#include "queue.h"

namespace refdgs::cuda {

struct DeviceThread {
  static constexpr unsigned kAll = 0xffffffffu;
  __device__ int block() const { return int(blockIdx.x); }
  __device__ int thread() const { return int(threadIdx.x); }
  __device__ int lane() const { return int(threadIdx.x) % kWarp; }
  __device__ int warp() const { return int(threadIdx.x) / kWarp; }
  __device__ void sync() { __syncthreads(); }
  __device__ void sync_warp() { __syncwarp(); }
  template <class V> __device__ V shuffle(V v, int lane) { return __shfl_sync(kAll, v, lane); }
  template <class V> __device__ V shuffle_xor(V v, int mask) { return __shfl_xor_sync(kAll, v, mask); }
  __device__ uint32_t ballot(bool p) { return __ballot_sync(kAll, p); }
  __device__ bool any(bool p) { return __any_sync(kAll, p); }
  __device__ float tf32(float x) {
#if __CUDA_ARCH__ >= 800
    uint32_t bits;
    asm("cvt.rna.tf32.f32 %0, %1;" : "=r"(bits) : "f"(x));
    return __uint_as_float(bits);
#else
    return x;
#endif
  }
  // c [16][8] += a [16][8] b [8][8], the warp's lanes together; who has what: PTX ISA, mma.m16n8k8 for .tf32.
  __device__ void mma(float* c, const float* a, const float* b) {
#if __CUDA_ARCH__ >= 800
    asm volatile(
        "mma.sync.aligned.m16n8k8.row.col.f32.tf32.tf32.f32 {%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, "
        "{%0, %1, %2, %3};"
        : "+f"(c[0]), "+f"(c[1]), "+f"(c[2]), "+f"(c[3])
        : "r"(__float_as_uint(a[0])), "r"(__float_as_uint(a[1])), "r"(__float_as_uint(a[2])),
          "r"(__float_as_uint(a[3])), "r"(__float_as_uint(b[0])), "r"(__float_as_uint(b[1])));
#else
    __trap();
#endif
  }
  __device__ uint32_t pair(float a, float b) {
#if __CUDA_ARCH__ >= 800
    uint32_t both;
    asm("cvt.rn.bf16x2.f32 %0, %1, %2;" : "=r"(both) : "f"(b), "f"(a));
    return both;
#else
    return 0;
#endif
  }
  __device__ uint16_t half(float x) { return uint16_t(pair(x, 0.0f)); }
  __device__ float whole(uint16_t x) { return __uint_as_float(uint32_t(x) << 16); }
  __device__ float first(uint32_t p) { return __uint_as_float(p << 16); }
  __device__ float second(uint32_t p) { return __uint_as_float(p & 0xffff0000u); }
  __device__ uint32_t where_positive(uint32_t h, uint32_t p) {  // h is never negative
    return ((h & 0xffffu) ? p & 0xffffu : 0u) | ((h >> 16) ? p & 0xffff0000u : 0u);
  }
  __device__ void put_pair(uint16_t* at, uint32_t p) { *reinterpret_cast<uint32_t*>(at) = p; }
  // c [16][8] += a [16][16] b [16][8], the warp's lanes together; who has what: PTX ISA, mma.m16n8k16 for .bf16.
  __device__ void mma_half(float* c, const uint32_t* a, const uint32_t* b) {
#if __CUDA_ARCH__ >= 800
    asm volatile(
        "mma.sync.aligned.m16n8k16.row.col.f32.bf16.bf16.f32 {%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, "
        "{%0, %1, %2, %3};"
        : "+f"(c[0]), "+f"(c[1]), "+f"(c[2]), "+f"(c[3])
        : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b[0]), "r"(b[1]));
#else
    __trap();
#endif
  }
  template <bool Turned> __device__ void load_pairs(uint32_t* r, const uint16_t* row) {
    const uint32_t at = uint32_t(__cvta_generic_to_shared(row));
    if (Turned)
      asm volatile("ldmatrix.sync.aligned.m8n8.x4.trans.shared.b16 {%0, %1, %2, %3}, [%4];"
                   : "=r"(r[0]), "=r"(r[1]), "=r"(r[2]), "=r"(r[3]) : "r"(at) : "memory");
    else
      asm volatile("ldmatrix.sync.aligned.m8n8.x4.shared.b16 {%0, %1, %2, %3}, [%4];"
                   : "=r"(r[0]), "=r"(r[1]), "=r"(r[2]), "=r"(r[3]) : "r"(at) : "memory");
  }
  __device__ void add_bits(int64_t* p, int64_t v) {
    atomicAdd(reinterpret_cast<unsigned long long*>(p), static_cast<unsigned long long>(v));
  }
  __device__ int64_t fetch_add(int64_t* p, int64_t v) {
    return int64_t(atomicAdd(reinterpret_cast<unsigned long long*>(p), static_cast<unsigned long long>(v)));
  }
  __device__ void raise_bits(uint32_t* p, uint32_t v) { atomicMax(p, v); }
};

// Blocks that an SM must have registers for: a kernel may name kResident.
template <class K, class = void> struct Resident {
  static constexpr int blocks = 1;
};
template <class K> struct Resident<K, std::void_t<decltype(K::kResident)>> {
  static constexpr int blocks = K::kResident;
};

template <class K> __global__ void __launch_bounds__(K::kThreads, Resident<K>::blocks) enter(const K kernel) {
  __shared__ typename K::Shared shared;
  DeviceThread thread;
  kernel(thread, shared);
}

inline void check(cudaError_t status, const char* what) {
  if (status != cudaSuccess) throw std::runtime_error(std::string("CUDA: ") + cudaGetErrorString(status) + " at " + what);
}

template <class K> void DeviceQueue::run(int64_t blocks, const K& kernel) const {
  if (!blocks) return;
  enter<K><<<unsigned(blocks), K::kThreads, 0, static_cast<cudaStream_t>(stream)>>>(kernel);
  check(cudaGetLastError(), typeid(K).name());
}

}  // namespace refdgs::cuda
