// The network of three hidden layers and at most 15 inputs with products of bfloat16 numbers and float sums, by tensor
// cores. A warp has 16 points. What a layer makes lies in the registers in which the next one's operand is wanted, so
// hidden values of forward never leave them, and nothing waits for another warp. All weights lie in shared memory, read
// once by each block, which goes on from tile to tile.
//
// The first layer's products are of numbers in two parts (high and low, three products), the last layer's of floats,
// both as exact as about 2^-16: what the network is told, and what it says, are not rounded. Hidden values, and the
// gradients that pass them, are rounded to bfloat16, as on the CPU (ops/mlp_half.inl).
//
// Backward computes the hidden values again and keeps them in registers. For the weights' gradients a block's four warps
// exchange their 64 points' values and gradients through shared memory; each warp adds 16 rows of every layer's gradient
// in registers, over all of the block's tiles. SumParts adds the blocks' parts in one order. No atomics.
//
// At 331,000 points: a warp takes some 650 instructions forward for 16 points, 150 of them products, and 1,500 backward,
// 250 of them products: 14 and 31 M instructions, floors of 15 and 33 us at four a clock on 132 processors of 1.75 GHz.
// 56 and 90 MB of points are 13 and 21 us at 4.3 TB/s.
#pragma once
#include <cmath>

#include "grid.h"
#include "mlp.h"

namespace refdgs::cuda {

constexpr int kHalfPoints = 64, kHalfThreads = 128, kHalfWarps = kHalfThreads / kWarp;
constexpr int kHalfSide = kHidden + 8;  // numbers between rows in shared memory: eight rows start in different banks
constexpr int kHalfFirst = 16, kHalfFirstSide = 24;  // inputs of the first layer and the 1 of its bias, padded
constexpr int kHalfLayers = 3;

inline bool fits_half(const MlpShape& shape) {
  return shape.hidden_layers == kHalfLayers && shape.inputs < kHalfFirst;
}

template <class S> struct HalfWeights {
  using One = typename Halved<S>::One;
  alignas(16) One inner[kHalfLayers - 1][kHidden * kHalfSide];  // [output][input]
  alignas(16) One high[kHidden * kHalfFirstSide], low[kHidden * kHalfFirstSide];  // first layer; its bias is one more input
  S last[kMlpOutputs * kHidden];  // zeros after the outputs
  S bias[kHalfLayers - 1][kHidden];

  template <class Thread> REFDGS_KERNEL void load(Thread& t, const MlpCall<S>& f) {
    const int inputs = f.shape.inputs;
    for (int l = 1; l < kHalfLayers; ++l) {
      for (int i = t.thread(); i < kHidden * kHidden; i += kHalfThreads)
        inner[l - 1][i / kHidden * kHalfSide + i % kHidden] = t.half(f.net.weights[l][i]);
      for (int i = t.thread(); i < kHidden; i += kHalfThreads) bias[l - 1][i] = f.net.bias[l][i];
    }
    for (int i = t.thread(); i < kHidden * kHalfFirst; i += kHalfThreads) {
      const int o = i / kHalfFirst, k = i % kHalfFirst;
      const S w = k < inputs ? f.net.weights[0][o * inputs + k] : k == inputs ? f.net.bias[0][o] : S(0);
      const One part = t.half(w);
      high[o * kHalfFirstSide + k] = part;
      low[o * kHalfFirstSide + k] = t.half(w - t.whole(part));
    }
    for (int i = t.thread(); i < kMlpOutputs * kHidden; i += kHalfThreads)
      last[i] = i < f.shape.outputs * kHidden ? f.net.weights[kHalfLayers][i] : S(0);
  }
};

// A warp's 16 points. Lane: group = lane / 4, quarter = lane % 4. It has of a product's result, for tile j of 8 units,
// points group and group + 8, units 8 j + 2 quarter and the next; of an operand, for step s of 16 units, the same
// points, and those units and the ones 8 further (PTX ISA, mma.m16n8k16 for .bf16).
template <class S> struct HalfWarp {
  using One = typename Halved<S>::One;
  using Pair = typename Halved<S>::Pair;
  const MlpCall<S>& f;
  int64_t count, rows[2];  // points of this lane
  int group, quarter, place, part;

  template <class Thread> REFDGS_KERNEL HalfWarp(Thread& t, const MlpCall<S>& call, int64_t tile, int64_t points)
      : f(call), count(points), group(t.lane() / 4), quarter(t.lane() % 4), place(t.lane() % 8), part(t.lane() / 8) {
    rows[0] = tile * kHalfPoints + t.warp() * 16 + group;
    rows[1] = rows[0] + 8;
  }

  // The address that this lane gives for four 8 x 8 matrices, two along the rows and two along the columns.
  // across: the second one lies along a row; else the third does.
  template <bool Across> REFDGS_KERNEL const One* corner(const One* at, int side, int row, int column) const {
    const int down = Across ? part / 2 : part % 2, right = Across ? part % 2 : part / 2;
    return at + (row + 8 * down + place) * side + column + 8 * right;
  }

  REFDGS_KERNEL S input(int64_t point, int c) const {
    if (point >= count) return 0;
    return c < f.shape.inputs ? f.x_at(point, c) : c == f.shape.inputs ? S(1) : S(0);
  }
  template <class Thread> REFDGS_KERNEL void read(Thread& t, Pair* high, Pair* low) const {
    REFDGS_UNROLL
    for (int i = 0; i < 4; ++i) {
      const int c = 2 * quarter + i / 2 * 8;
      const S a = input(rows[i % 2], c), b = input(rows[i % 2], c + 1);
      high[i] = t.pair(a, b);
      low[i] = t.pair(a - t.first(high[i]), b - t.second(high[i]));
    }
  }

  // y = the first layer before its ReLU.
  template <class Thread>
  REFDGS_KERNEL void enter(Thread& t, const HalfWeights<S>& w, const Pair* high, const Pair* low, S (*y)[4]) const {
    REFDGS_UNROLL
    for (int j = 0; j < 8; j += 2) {
      Pair b[4], rest[4];
      t.template load_pairs<false>(b, corner<true>(w.high, kHalfFirstSide, 8 * j, 0));
      t.template load_pairs<false>(rest, corner<true>(w.low, kHalfFirstSide, 8 * j, 0));
      REFDGS_UNROLL
      for (int k = 0; k < 2; ++k) {
        S* to = y[j + k];
        to[0] = to[1] = to[2] = to[3] = 0;
        t.mma_half(to, low, b + 2 * k);
        t.mma_half(to, high, rest + 2 * k);
        t.mma_half(to, high, b + 2 * k);
      }
    }
  }
  // y = inner layer l of the operand h, before its ReLU.
  template <class Thread>
  REFDGS_KERNEL void pass(Thread& t, const HalfWeights<S>& w, int l, const Pair* h, S (*y)[4]) const {
    REFDGS_UNROLL
    for (int j = 0; j < 8; ++j) {
      y[j][0] = y[j][2] = w.bias[l][8 * j + 2 * quarter];
      y[j][1] = y[j][3] = w.bias[l][8 * j + 2 * quarter + 1];
    }
    REFDGS_UNROLL
    for (int s = 0; s < 4; ++s)
      REFDGS_UNROLL
      for (int j = 0; j < 8; j += 2) {
        Pair b[4];
        t.template load_pairs<false>(b, corner<true>(w.inner[l], kHalfSide, 8 * j, 16 * s));
        t.mma_half(y[j], h + 4 * s, b);
        t.mma_half(y[j + 1], h + 4 * s, b + 2);
      }
  }
  static REFDGS_KERNEL S positive(S x) { return x > 0 ? x : S(0); }
  // The operand that a result is, after the ReLU.
  template <class Thread> static REFDGS_KERNEL void keep(Thread& t, const S (*y)[4], Pair* h) {
    REFDGS_UNROLL
    for (int i = 0; i < 16; ++i) {
      const S* from = y[i / 4 * 2 + i % 4 / 2] + i % 2 * 2;
      h[i] = t.pair(positive(from[0]), positive(from[1]));
    }
  }
  // The operand that gradients y are where the hidden value is positive.
  template <class Thread> static REFDGS_KERNEL void keep_where(Thread& t, const S (*y)[4], const Pair* h, Pair* g) {
    REFDGS_UNROLL
    for (int i = 0; i < 16; ++i) {
      const S* from = y[i / 4 * 2 + i % 4 / 2] + i % 2 * 2;
      g[i] = t.where_positive(h[i], t.pair(from[0], from[1]));
    }
  }

  // y = gradients by the inputs of the layer whose weights [64][side] these are; J tiles of 8.
  template <int J, class Thread>
  REFDGS_KERNEL void back(Thread& t, const One* weights, int side, const Pair* g, S (*y)[4]) const {
    REFDGS_UNROLL
    for (int j = 0; j < J; ++j) y[j][0] = y[j][1] = y[j][2] = y[j][3] = 0;
    REFDGS_UNROLL
    for (int s = 0; s < 4; ++s)
      REFDGS_UNROLL
      for (int j = 0; j < J; j += 2) {
        Pair b[4];
        t.template load_pairs<true>(b, corner<false>(weights, side, 16 * s, 8 * j));
        t.mma_half(y[j], g + 4 * s, b);
        t.mma_half(y[j + 1], g + 4 * s, b + 2);
      }
  }

  // To shared memory: [point of the block][unit].
  template <class Thread> REFDGS_KERNEL void put(Thread& t, const Pair* h, One* to) const {
    REFDGS_UNROLL
    for (int i = 0; i < 16; ++i)
      t.put_pair(to + (t.warp() * 16 + group + i % 2 * 8) * kHalfSide + i / 2 * 8 + 2 * quarter, h[i]);
  }
};

// A thread has outputs `quarter` of two points at the end.
template <class S> struct MlpForwardHalf {
  static constexpr int kThreads = kHalfThreads, kResident = 4;
  using Shared = HalfWeights<S>;
  using Pair = typename Halved<S>::Pair;
  MlpCall<S> f;
  int64_t blocks;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared& s) const {
    s.load(t, f);
    t.sync();
    const int64_t points = f.count(), tiles = (points + kHalfPoints - 1) / kHalfPoints;
    for (int64_t tile = t.block(); tile < tiles; tile += blocks) {
      const HalfWarp<S> warp(t, f, tile, points);
      Pair high[4], low[4], h[16];
      S y[8][4];
      warp.read(t, high, low);
      warp.enter(t, s, high, low, y);
      warp.keep(t, y, h);
      warp.pass(t, s, 0, h, y);
      warp.keep(t, y, h);
      warp.pass(t, s, 1, h, y);
      leave(t, warp, s, y);
    }
  }

  template <class Thread>
  REFDGS_KERNEL void leave(Thread& t, const HalfWarp<S>& warp, const Shared& s, const S (*y)[4]) const {
    const int q = warp.quarter;
    S sum[2][kMlpOutputs] = {};
    REFDGS_UNROLL
    for (int j = 0; j < 8; ++j) {
      REFDGS_UNROLL
      for (int o = 0; o < kMlpOutputs; ++o) {
        const S *w = s.last + o * kHidden + 8 * j + 2 * q;
        REFDGS_UNROLL
        for (int r = 0; r < 2; ++r)
          sum[r][o] += warp.positive(y[j][2 * r]) * w[0] + warp.positive(y[j][2 * r + 1]) * w[1];
      }
    }
    REFDGS_UNROLL
    for (int r = 0; r < 2; ++r) {
      S mine = 0;
      REFDGS_UNROLL
      for (int o = 0; o < kMlpOutputs; ++o) {
        S total = sum[r][o] + t.shuffle_xor(sum[r][o], 1);
        total += t.shuffle_xor(total, 2);
        if (o == q) mine = total;
      }
      if (q >= f.shape.outputs || warp.rows[r] >= warp.count) continue;
      S v = mine + f.net.bias[kHalfLayers][q];
      if (f.points.has_exp) v = v < f.cap ? std::exp(v) : v >= f.cap ? f.largest : v;  // a NaN stays one
      f.out[warp.rows[r] * f.shape.outputs + q] = v;
    }
  }
};

template <class S> struct MlpBackwardHalf {
  static constexpr int kThreads = kHalfThreads, kResident = 2;
  using One = typename Halved<S>::One;
  using Pair = typename Halved<S>::Pair;
  struct Shared {
    HalfWeights<S> w;
    alignas(16) One h[kHalfPoints * kHalfSide], g[kHalfPoints * kHalfSide];  // a layer's inputs, gradients by its outputs
    alignas(16) One x[kHalfPoints * kHalfFirstSide], v[kHalfPoints * 8];     // of the first layer, and of the last
    S ends[kHalfWarps][kMlpOutputs];
  };
  MlpCall<S> f;

  // What a warp adds up: rows 16 warp + group and 8 further of every layer's gradient, by units of its outputs (of the
  // last layer: of its inputs).
  struct Sums {
    S first[2][4] = {}, inner[kHalfLayers - 1][8][4] = {}, bias[kHalfLayers - 1][4] = {}, last[4] = {}, end = 0;
  };

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared& s) const {
    s.w.load(t, f);
    for (int i = t.thread(); i < kHalfPoints * 8; i += kThreads) s.v[i] = t.half(S(0));
    const int64_t points = f.count(), tiles = (points + kHalfPoints - 1) / kHalfPoints;
    Sums sums;
    for (int64_t tile = t.block(); tile < tiles; tile += f.blocks) {
      t.sync();  // weights are there; the last tile's values have been read
      const HalfWarp<S> warp(t, f, tile, points);
      Pair h[kHalfLayers][16], g[16];
      S y[8][4];
      again(t, warp, s, h, y);
      begin_back(t, warp, s, sums, y);
      warp.keep_where(t, y, h[2], g);
      warp.put(t, h[2], s.h);
      warp.put(t, g, s.g);
      t.sync();
      add_last(t, warp, s, sums.last);
      warp.template back<8>(t, s.w.inner[1], kHalfSide, g, y);
      warp.keep_where(t, y, h[1], g);
      t.sync();
      warp.put(t, h[1], s.h);
      t.sync();
      add<8>(t, warp, s, s.h, kHalfSide, sums.inner[1], sums.bias[1]);
      warp.template back<8>(t, s.w.inner[0], kHalfSide, g, y);
      t.sync();
      warp.put(t, h[0], s.h);
      warp.put(t, g, s.g);
      warp.keep_where(t, y, h[0], g);
      t.sync();
      add<8>(t, warp, s, s.h, kHalfSide, sums.inner[0], sums.bias[0]);
      t.sync();
      warp.put(t, g, s.g);
      t.sync();
      S none[4];
      add<2>(t, warp, s, s.x, kHalfFirstSide, sums.first, none);
      if (f.v_x.count) leave_back(t, warp, s, g);
    }
    write(t, s, sums);
  }

  // The hidden values, and the first layer's inputs to shared memory.
  template <class Thread>
  REFDGS_KERNEL void again(Thread& t, const HalfWarp<S>& warp, Shared& s, Pair (*h)[16], S (*y)[4]) const {
    Pair high[4], low[4];
    warp.read(t, high, low);
    REFDGS_UNROLL
    for (int i = 0; i < 4; ++i)
      t.put_pair(s.x + (t.warp() * 16 + warp.group + i % 2 * 8) * kHalfFirstSide + i / 2 * 8 + 2 * warp.quarter, high[i]);
    warp.enter(t, s.w, high, low, y);
    warp.keep(t, y, h[0]);
    REFDGS_UNROLL
    for (int l = 1; l < kHalfLayers; ++l) {
      warp.pass(t, s.w, l - 1, h[l - 1], y);
      warp.keep(t, y, h[l]);
    }
  }

  // y = gradients by the last hidden layer's values, in floats; those by the outputs to shared memory.
  template <class Thread>
  REFDGS_KERNEL void begin_back(Thread& t, const HalfWarp<S>& warp, Shared& s, Sums& sums, S (*y)[4]) const {
    const int q = warp.quarter;
    S all[2][kMlpOutputs];
    REFDGS_UNROLL
    for (int r = 0; r < 2; ++r) {
      S own = 0;
      if (q < f.shape.outputs && warp.rows[r] < warp.count) {
        const int64_t at = warp.rows[r] * f.shape.outputs + q;
        own = f.v_out[at];
        if (f.points.has_exp) own = f.out[at] < f.largest || own > 0 ? own * f.out[at] : S(0);  // down, never up
      }
      sums.end += own;
      s.v[(t.warp() * 16 + warp.group + 8 * r) * 8 + q] = t.half(own);
      REFDGS_UNROLL
      for (int o = 0; o < kMlpOutputs; ++o) all[r][o] = t.shuffle(own, warp.group * 4 + o);
    }
    REFDGS_UNROLL
    for (int j = 0; j < 8; ++j) {
      y[j][0] = y[j][1] = y[j][2] = y[j][3] = 0;
      REFDGS_UNROLL
      for (int o = 0; o < kMlpOutputs; ++o) {
        const S* w = s.w.last + o * kHidden + 8 * j + 2 * q;
        REFDGS_UNROLL
        for (int i = 0; i < 4; ++i) y[j][i] += all[i / 2][o] * w[i % 2];
      }
    }
  }

  // sum += gradients g [point][16 of this warp's units] times the layer's inputs [point][8 J]; bias: its column sums.
  template <int J, class Thread>
  REFDGS_KERNEL void add(Thread& t, const HalfWarp<S>& warp, const Shared& s, const One* in, int side, S (*sum)[4],
                         S* bias) const {
    const Pair ones[2] = {t.pair(S(1), S(1)), t.pair(S(1), S(1))};
    REFDGS_UNROLL
    for (int k = 0; k < kHalfPoints / 16; ++k) {
      Pair a[4];
      t.template load_pairs<true>(a, warp.template corner<true>(s.g, kHalfSide, 16 * k, 16 * t.warp()));
      if (J == 8) t.mma_half(bias, a, ones);
      REFDGS_UNROLL
      for (int j = 0; j < J; j += 2) {
        Pair b[4];
        t.template load_pairs<true>(b, warp.template corner<false>(in, side, 16 * k, 8 * j));
        t.mma_half(sum[j], a, b);
        t.mma_half(sum[j + 1], a, b + 2);
      }
    }
  }
  // sum += last hidden values [point][16 of this warp's units] times gradients by the outputs [point][8].
  template <class Thread>
  REFDGS_KERNEL void add_last(Thread& t, const HalfWarp<S>& warp, const Shared& s, S* sum) const {
    REFDGS_UNROLL
    for (int k = 0; k < kHalfPoints / 16; k += 2) {
      Pair b[4];  // of 32 points
      t.template load_pairs<true>(b, s.v + (16 * k + t.lane()) * 8);
      REFDGS_UNROLL
      for (int i = 0; i < 2; ++i) {
        Pair a[4];
        t.template load_pairs<true>(a, warp.template corner<true>(s.h, kHalfSide, 16 * (k + i), 16 * t.warp()));
        t.mma_half(sum, a, b + 2 * i);
      }
    }
  }

  template <class Thread>
  REFDGS_KERNEL void leave_back(Thread& t, const HalfWarp<S>& warp, const Shared& s, const Pair* g) const {
    S y[2][4];
    warp.template back<2>(t, s.w.high, kHalfFirstSide, g, y);
    REFDGS_UNROLL
    for (int j = 0; j < 2; ++j)
      REFDGS_UNROLL
      for (int i = 0; i < 4; ++i) {
        const int c = 8 * j + 2 * warp.quarter + i % 2;
        const int64_t row = warp.rows[i / 2];
        if (row < warp.count && c < f.shape.inputs) f.set_v_x(row, c, y[j][i]);
      }
  }

  // This block's part of all gradients, as MlpCall::start has it.
  template <class Thread> REFDGS_KERNEL void write(Thread& t, Shared& s, const Sums& sums) const {
    const int g = t.lane() / 4, q = t.lane() % 4, inputs = f.shape.inputs, outputs = f.shape.outputs;
    S* part = f.parts + int64_t(t.block()) * f.numbers();
    REFDGS_UNROLL
    for (int i = 0; i < 4; ++i) {
      const int m = t.warp() * 16 + g + i / 2 * 8, column = 2 * q + i % 2;
      REFDGS_UNROLL
      for (int j = 0; j < 2; ++j) {
        const int n = 8 * j + column;
        if (n < inputs) part[m * inputs + n] = sums.first[j][i];
        else if (n == inputs) part[kHidden * inputs + m] = sums.first[j][i];
      }
      REFDGS_UNROLL
      for (int l = 1; l < kHalfLayers; ++l) {
        S* to = part + f.start(l);
        REFDGS_UNROLL
        for (int j = 0; j < 8; ++j) to[m * kHidden + 8 * j + column] = sums.inner[l - 1][j][i];
        if (column == 0) to[kHidden * kHidden + m] = sums.bias[l - 1][i];
      }
      if (column < outputs) part[f.start(kHalfLayers) + column * kHidden + m] = sums.last[i];
    }
    S end = sums.end;
    for (int mask = 4; mask < kWarp; mask *= 2) end += t.shuffle_xor(end, mask);
    t.sync();
    if (g == 0) s.ends[t.warp()][q] = end;
    t.sync();
    if (t.thread() >= outputs) return;
    S total = 0;
    for (int w = 0; w < kHalfWarps; ++w) total += s.ends[w][t.thread()];
    part[f.start(kHalfLayers) + outputs * kHidden + t.thread()] = total;
  }
};

}  // namespace refdgs::cuda
