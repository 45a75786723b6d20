// The shader's network. A block takes tiles of 64 points. Activations lie in shared memory as [unit][point], weights as
// [unit of one side][unit of the other], and each of 256 threads computes 4 x 4 of the 64 x 64 results of a layer from
// two quads a step: 2 loads for 16 multiplications, 2 cycles of shared memory for 4 of arithmetic on an SM. Backward
// computes the hidden values again, keeps them in a scratch of its own that stays in the second-level cache, and adds
// its share of the weights' gradient to a part of its own; SumParts adds the parts in one order. No atomics.
//
// At 320,000 points of 10 inputs: 2 x 9,152 flop forward, three times that and the hidden layers again backward: 5.9
// and 23 GFLOP: floors of 0.09 and 0.35 ms at 67 TFLOP/s in fp32; 56 and 150 MB of points are 13 and 35 us. Weights of
// 16 kB a tile and layer, the parts (32 kB) and the hidden values (48 kB) pass the second-level cache: 1.3 GB, 0.25 ms
// of it, at the same time as the arithmetic. Tensor cores (three products of TF32 for fp32's accuracy) would pass it.
#pragma once
#include <cmath>

#include "../math/hit.h"  // most_of
#include "grid.h"
#include "mlp.h"

namespace refdgs::cuda {

// [rows][kMlpSide], rows of 64 used.
template <class S> struct MlpShared {
  alignas(4 * sizeof(S)) S a[kHidden * kMlpSide];
  alignas(4 * sizeof(S)) S b[kHidden * kMlpSide];
};

template <class S> struct Block4 {
  S v[4][4];
};

// The thread's 4 x 4 of  sum over k < depth of  a[k][4 m + i] b[k][4 n + j]. A warp's lanes have 8 m and 4 n.
template <class Thread> REFDGS_KERNEL int block_m(Thread& t) { return t.lane() % 8 + t.warp() % 2 * 8; }
template <class Thread> REFDGS_KERNEL int block_n(Thread& t) { return t.lane() / 8 + t.warp() / 2 * 4; }
template <class S, class Thread> REFDGS_KERNEL Block4<S> product4(Thread& t, const S* a, const S* b, int depth) {
  Block4<S> sum{};
  const S *from_a = a + 4 * block_m(t), *from_b = b + 4 * block_n(t);
  for (int k = 0; k < depth; ++k, from_a += kMlpSide, from_b += kMlpSide) {
    S va[4], vb[4];
    copy_quads<4>(va, from_a);
    copy_quads<4>(vb, from_b);
    for (int i = 0; i < 4; ++i)
      for (int j = 0; j < 4; ++j) sum.v[i][j] += va[i] * vb[j];
  }
  return sum;
}

template <class S> struct MlpTile {
  const MlpCall<S>& f;
  int64_t begin;
  int points;

  REFDGS_KERNEL MlpTile(const MlpCall<S>& call, int64_t tile) : f(call), begin(tile * kMlpPoints) {
    const int64_t left = call.points.count - begin;
    points = left < kMlpPoints ? int(left) : kMlpPoints;
  }

  template <class Thread> REFDGS_KERNEL void load_x(Thread& t, S* to) const {
    for (int i = t.thread(); i < f.shape.inputs * kMlpPoints; i += kMlpThreads) {
      const int c = i / kMlpPoints, p = i % kMlpPoints;
      to[c * kMlpSide + p] = p < points ? f.x[(begin + p) * f.x_row + c * f.x_column] : S(0);
    }
  }

  // Layer l's weights as [input][output], zeros for outputs that are not there.
  template <class Thread> REFDGS_KERNEL void load_weights(Thread& t, int l, S* to) const {
    const int inputs = f.inputs(l), outputs = f.outputs(l);
    for (int i = t.thread(); i < inputs * kHidden; i += kMlpThreads) {
      const int o = i / inputs, k = i % inputs;
      to[k * kMlpSide + o] = o < outputs ? f.net.weights[l][o * inputs + k] : S(0);
    }
  }
  // And as [output][input].
  template <class Thread> REFDGS_KERNEL void load_transposed(Thread& t, int l, S* to) const {
    const int inputs = f.inputs(l), outputs = f.outputs(l);
    for (int i = t.thread(); i < outputs * kHidden; i += kMlpThreads) {
      const int o = i / kHidden, k = i % kHidden;
      to[o * kMlpSide + k] = k < inputs ? f.net.weights[l][o * inputs + k] : S(0);
    }
  }

  // s.a: the inputs; becomes the outputs of hidden layer l, which go to `keep` too if it is not null.
  template <class Thread> REFDGS_KERNEL void hidden_layer(Thread& t, MlpShared<S>& s, int l, S* keep) const {
    load_weights(t, l, s.b);
    t.sync();
    const Block4<S> sum = product4(t, s.a, s.b, f.inputs(l));
    t.sync();
    const int m = 4 * block_m(t), n = 4 * block_n(t);
    for (int j = 0; j < 4; ++j) {
      const S bias = f.net.bias[l][n + j];
      S h[4];
      for (int i = 0; i < 4; ++i) {
        const S y = sum.v[i][j] + bias;
        h[i] = y > 0 ? y : S(0);
      }
      put_quad(s.a + (n + j) * kMlpSide + m, h);
      if (keep) put_quad(keep + (n + j) * kMlpPoints + m, h);
    }
    t.sync();
  }
};

// A thread: one point and one output at the end, 64 x 4.
template <class S> struct MlpForward {
  static constexpr int kThreads = kMlpThreads;
  using Shared = MlpShared<S>;
  MlpCall<S> f;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared& s) const {
    const MlpTile<S> tile(f, t.block());
    tile.load_x(t, s.a);
    for (int l = 0; l < f.shape.hidden_layers; ++l) tile.hidden_layer(t, s, l, static_cast<S*>(nullptr));
    const int p = t.thread() % kMlpPoints, o = t.thread() / kMlpPoints, last = f.shape.hidden_layers;
    if (p >= tile.points || o >= f.shape.outputs) return;
    S y = f.net.bias[last][o];
    for (int k = 0; k < kHidden; ++k) y += f.net.weights[last][o * kHidden + k] * s.a[k * kMlpSide + p];
    if (f.points.has_exp) y = y < f.cap ? std::exp(y) : y >= f.cap ? f.largest : y;  // a NaN stays one
    f.out[(tile.begin + p) * f.shape.outputs + o] = y;
  }
};

template <class S> struct MlpBackward {
  static constexpr int kThreads = kMlpThreads, kResident = 3;
  using Shared = MlpShared<S>;
  MlpCall<S> f;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared& s) const {
    const int64_t tiles = (f.points.count + kMlpPoints - 1) / kMlpPoints;
    S* part = f.parts + int64_t(t.block()) * f.numbers();
    S* hidden = f.hidden + int64_t(t.block()) * f.shape.hidden_layers * kHidden * kMlpPoints;
    for (int i = t.thread(); i < f.numbers(); i += kThreads) part[i] = 0;
    for (int64_t index = t.block(); index < tiles; index += f.blocks) {
      const MlpTile<S> tile(f, index);
      t.sync();
      tile.load_x(t, s.a);
      for (int l = 0; l < f.shape.hidden_layers; ++l)
        tile.hidden_layer(t, s, l, hidden + int64_t(l) * kHidden * kMlpPoints);
      load_v_out(t, tile, s.a);
      for (int l = f.shape.hidden_layers; l >= 0; --l) {
        load_inputs(t, tile, l, hidden, s.b);
        t.sync();
        add_weights(t, l, s, part + f.start(l));
        t.sync();
        if (l || f.v_x) inputs_vjp(t, tile, l, s, hidden);
      }
    }
  }

  // [output][point], zeros where there is no point.
  template <class Thread> REFDGS_KERNEL void load_v_out(Thread& t, const MlpTile<S>& tile, S* to) const {
    for (int i = t.thread(); i < f.shape.outputs * kMlpPoints; i += kThreads) {
      const int o = i / kMlpPoints, p = i % kMlpPoints;
      S g = 0;
      if (p < tile.points) {
        const int64_t at = (tile.begin + p) * f.shape.outputs + o;
        g = f.v_out[at];
        if (f.points.has_exp) g = f.out[at] < f.largest || g > 0 ? g * f.out[at] : S(0);  // down, never up
      }
      to[o * kMlpSide + p] = g;
    }
  }

  // What layer l was given, [input][point].
  template <class Thread>
  REFDGS_KERNEL void load_inputs(Thread& t, const MlpTile<S>& tile, int l, const S* hidden, S* to) const {
    if (!l) return tile.load_x(t, to);
    const S* from = hidden + int64_t(l - 1) * kHidden * kMlpPoints;
    for (int i = t.thread(); i < kHidden * kMlpPoints; i += kThreads)
      to[i / kMlpPoints * kMlpSide + i % kMlpPoints] = from[i];
  }

  // Adds sum over points of a[output][point] b[input][point], and of a for the bias. A thread has the outputs m,
  // m + 16.. and the inputs n, n + 16..: neighbours in a warp read neighbouring rows, which lie in different banks.
  template <class Thread> REFDGS_KERNEL void add_weights(Thread& t, int l, const Shared& s, S* part) const {
    const int outputs = f.outputs(l), inputs = f.inputs(l), m = block_m(t), n = block_n(t);
    S sum[4][4] = {};
    if (m < outputs && n < inputs)
      for (int p = 0; p < kMlpPoints; p += 4) {
        S a[4][4], b[4][4];
        for (int i = 0; i < 4; ++i) {
          copy_quads<4>(a[i], s.a + (m + 16 * i) * kMlpSide + p);
          copy_quads<4>(b[i], s.b + (n + 16 * i) * kMlpSide + p);
        }
        for (int i = 0; i < 4; ++i)
          for (int j = 0; j < 4; ++j)
            for (int k = 0; k < 4; ++k) sum[i][j] += a[i][k] * b[j][k];
      }
    for (int i = 0; i < 4; ++i)
      for (int j = 0; j < 4; ++j)
        if (m + 16 * i < outputs && n + 16 * j < inputs) part[(m + 16 * i) * inputs + n + 16 * j] += sum[i][j];
    if (t.thread() < outputs) {
      S total = 0;
      for (int p = 0; p < kMlpPoints; ++p) total += s.a[t.thread() * kMlpSide + p];
      part[outputs * inputs + t.thread()] += total;
    }
  }

  // s.a: gradients by layer l's outputs; becomes those by the outputs of the layer before, or goes to v_x.
  template <class Thread>
  REFDGS_KERNEL void inputs_vjp(Thread& t, const MlpTile<S>& tile, int l, Shared& s, const S* hidden) const {
    tile.load_transposed(t, l, s.b);
    t.sync();
    const Block4<S> sum = product4(t, s.a, s.b, f.outputs(l));
    t.sync();
    const int m = 4 * block_m(t), n = 4 * block_n(t);
    for (int j = 0; j < 4; ++j) {
      if (l) {
        S h[4];
        copy_quads<4>(h, hidden + (int64_t(l - 1) * kHidden + n + j) * kMlpPoints + m);
        for (int i = 0; i < 4; ++i) h[i] = h[i] > 0 ? sum.v[i][j] : S(0);
        put_quad(s.a + (n + j) * kMlpSide + m, h);
      } else {
        for (int i = 0; i < 4; ++i)
          if (m + i < tile.points && n + j < f.shape.inputs)
            f.v_x[(tile.begin + m + i) * f.shape.inputs + n + j] = sum.v[i][j];
      }
    }
    t.sync();
  }
};

// A block: 32 numbers of the weights' and biases' gradients; each warp adds every eighth part.
template <class S> struct SumParts {
  static constexpr int kThreads = 256, kStripes = kThreads / kWarp;
  struct Shared {
    double sums[kStripes][kWarp];
  };
  MlpCall<S> f;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared& s) const {
    const int i = t.block() * kWarp + t.lane(), numbers = f.numbers();
    double sum = 0;
    if (i < numbers)
      for (int part = t.warp(); part < f.blocks; part += kStripes) sum += double(f.parts[int64_t(part) * numbers + i]);
    s.sums[t.warp()][t.lane()] = sum;
    t.sync();
    if (t.warp() || i >= numbers) return;
    for (int k = 1; k < kStripes; ++k) sum += s.sums[k][t.lane()];
    int l = 0;
    while (i >= f.start(l + 1)) ++l;
    const int at = i - f.start(l), weights = f.outputs(l) * f.inputs(l);
    (at < weights ? f.v_net.weights[l][at] : f.v_net.bias[l][at - weights]) = S(sum);
  }
};

}  // namespace refdgs::cuda
