// The products of 64 x 64 results that the network's layers take, a block's 256 threads together, 16 results each:
//     Product:  sum over k < depth of a[k][m] b[k][n]      a layer, or its way back
//     Outer:    sum over p < 64 of    a[m][p] b[n][p]      the weights' gradient
// each(t, visit) gives a thread its results as visit(m, n, value). a and b lie in shared memory with kMlpSide between rows;
// rows m and columns n that nobody asks for may hold anything.
//
// FmaProduct: 4 x 4 results a thread from two quads a step: 2 loads for 16 multiply-adds. MmaProduct: a warp has 16 x 32
// results, in four tensor core tiles of 16 x 8. Numbers are split into two TF32 parts each (x = high + low to 2^-21), of
// which three products are added in fp32: high x high, high x low and low x high; what is left out is 2^-22 of the
// result. kMlpSide and the order of k are such that no two lanes read or write in one bank.
#pragma once
#include "grid.h"
#include "mlp.h"

namespace refdgs::cuda {

constexpr int kMlpStep = 8;  // of k in a tensor core's product

template <class S> struct FmaProduct {
  S v[4][4] = {};

  // A warp's lanes have 8 m and 4 n.
  template <class Thread> static REFDGS_KERNEL int block_m(Thread& t) { return t.lane() % 8 + t.warp() % 2 * 8; }
  template <class Thread> static REFDGS_KERNEL int block_n(Thread& t) { return t.lane() / 8 + t.warp() / 2 * 4; }

  template <class Thread> REFDGS_KERNEL FmaProduct(Thread& t, const S* a, const S* b, int depth) {
    const S *from_a = a + 4 * block_m(t), *from_b = b + 4 * block_n(t);
    for (int k = 0; k < depth; ++k, from_a += kMlpSide, from_b += kMlpSide) {
      S va[4], vb[4];
      copy_quads<4>(va, from_a);
      copy_quads<4>(vb, from_b);
      for (int i = 0; i < 4; ++i)
        for (int j = 0; j < 4; ++j) v[i][j] += va[i] * vb[j];
    }
  }
  template <class Thread, class Visit> REFDGS_KERNEL void each(Thread& t, Visit visit) const {
    for (int j = 0; j < 4; ++j)
      for (int i = 0; i < 4; ++i) visit(4 * block_m(t) + i, 4 * block_n(t) + j, v[i][j]);
  }

  // A thread has rows m, m + 16.. and columns n, n + 16..: neighbours read neighbouring rows, in different banks.
  struct Outer {
    S v[4][4] = {};

    template <class Thread> REFDGS_KERNEL Outer(Thread& t, const S* a, const S* b, int rows, int columns) {
      const int m = block_m(t), n = block_n(t);
      if (m >= rows || n >= columns) return;
      for (int p = 0; p < kMlpPoints; p += 4) {
        S va[4][4], vb[4][4];
        for (int i = 0; i < 4; ++i) {
          copy_quads<4>(va[i], a + (m + 16 * i) * kMlpSide + p);
          copy_quads<4>(vb[i], b + (n + 16 * i) * kMlpSide + p);
        }
        for (int i = 0; i < 4; ++i)
          for (int j = 0; j < 4; ++j)
            for (int k = 0; k < 4; ++k) v[i][j] += va[i][k] * vb[j][k];
      }
    }
    template <class Thread, class Visit> REFDGS_KERNEL void each(Thread& t, Visit visit) const {
      for (int i = 0; i < 4; ++i)
        for (int j = 0; j < 4; ++j) visit(block_m(t) + 16 * i, block_n(t) + 16 * j, v[i][j]);
    }
  };
};

// Numbers of a tensor core's operand, each as two TF32 numbers.
template <class S, int N> struct Halves {
  S high[N], low[N];

  template <class Thread> REFDGS_KERNEL Halves(Thread& t, const S* x) {
    for (int i = 0; i < N; ++i) {
      high[i] = t.tf32(x[i]);
      low[i] = t.tf32(x[i] - high[i]);
    }
  }
};

// 16 x 32 results of a warp. The lane of row `group` and column `quarter` has, of a 16 x 8 operand of k and m, the
// numbers (k, m) = (quarter, group), (quarter, group + 8), (quarter + 4, group), (quarter + 4, group + 8); of an 8 x 8
// one (quarter, group), (quarter + 4, group); of the result (group, 2 quarter), (group, 2 quarter + 1) and the same 8
// rows on (PTX ISA, mma.m16n8k8 for .tf32).
template <class S> struct MmaSum {
  S v[4][4] = {};  // tile, and the lane's four of it

  template <class Thread> static REFDGS_KERNEL int group(Thread& t) { return t.lane() / 4; }
  template <class Thread> static REFDGS_KERNEL int quarter(Thread& t) { return t.lane() % 4; }
  template <class Thread> static REFDGS_KERNEL int first_m(Thread& t) { return t.warp() % 4 * 16; }
  template <class Thread> static REFDGS_KERNEL int first_n(Thread& t) { return t.warp() / 4 * 32; }

  template <class Thread> REFDGS_KERNEL void add(Thread& t, int tile, const Halves<S, 4>& a, const S* b2) {
    const Halves<S, 2> b(t, b2);
    t.mma(v[tile], a.low, b.high);  // the small ones first
    t.mma(v[tile], a.high, b.low);
    t.mma(v[tile], a.high, b.high);
  }
  template <class Thread, class Visit> REFDGS_KERNEL void each(Thread& t, Visit visit) const {
    for (int tile = 0; tile < 4; ++tile)
      for (int c = 0; c < 4; ++c)
        visit(first_m(t) + group(t) + c / 2 * 8, first_n(t) + 8 * tile + 2 * quarter(t) + c % 2, v[tile][c]);
  }
};

template <class S> struct MmaProduct : MmaSum<S> {
  using Sum = MmaSum<S>;

  template <class Thread> REFDGS_KERNEL MmaProduct(Thread& t, const S* a, const S* b, int depth) {
    // the operands' k are taken in the order 0 2 4 6 1 3 5 7
    const int g = Sum::group(t), k = 2 * Sum::quarter(t);
    const S *from_a = a + k * kMlpSide + Sum::first_m(t) + g, *from_b = b + k * kMlpSide + Sum::first_n(t) + g;
#if defined(__CUDACC__)
#pragma unroll 1  // more would spill
#endif
    for (int step = 0; step < depth; step += kMlpStep, from_a += kMlpStep * kMlpSide, from_b += kMlpStep * kMlpSide) {
      const S a4[4] = {from_a[0], from_a[8], from_a[kMlpSide], from_a[kMlpSide + 8]};
      const Halves<S, 4> halves(t, a4);
      for (int tile = 0; tile < 4; ++tile) {
        const S b2[2] = {from_b[8 * tile], from_b[8 * tile + kMlpSide]};
        Sum::add(t, tile, halves, b2);
      }
    }
  }

  struct Outer : MmaSum<S> {
    template <class Thread> REFDGS_KERNEL Outer(Thread& t, const S* a, const S* b, int rows, int columns) {
      const int g = Sum::group(t), q = Sum::quarter(t), m = Sum::first_m(t), n = Sum::first_n(t);
      if (m >= rows || n >= columns) return;  // the same for a whole warp
      const S *from_a = a + (m + g) * kMlpSide + q, *from_b = b + (n + g) * kMlpSide + q;
#if defined(__CUDACC__)
#pragma unroll 1
#endif
      for (int p = 0; p < kMlpPoints; p += kMlpStep, from_a += kMlpStep, from_b += kMlpStep) {
        const S a4[4] = {from_a[0], from_a[8 * kMlpSide], from_a[4], from_a[8 * kMlpSide + 4]};
        const Halves<S, 4> halves(t, a4);
        for (int tile = 0; tile < 4; ++tile) {
          const S b2[2] = {from_b[8 * tile * kMlpSide], from_b[8 * tile * kMlpSide + 4]};
          Sum::add(t, tile, halves, b2);
        }
      }
    }
  };
};

}  // namespace refdgs::cuda
