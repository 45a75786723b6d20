// The shader's network. A block takes tiles of 64 points. Activations lie in shared memory as [unit][point], weights as
// [unit of one side][unit of the other]; mlp_products.h has the products, by fused multiply-adds or by tensor cores.
// Backward computes the hidden values again, keeps them in a scratch of its own that stays in the second-level cache, and
// adds its share of the weights' gradient to a part of its own; SumParts adds the parts in one order. No atomics.
//
// At 320,000 points of 10 inputs: 2 x 9,152 flop forward, three times that and the hidden layers again backward: 5.9
// and 23 GFLOP: floors of 0.09 and 0.35 ms at 67 TFLOP/s in fp32, and of 0.04 and 0.14 ms by tensor cores (three TF32
// products each, 495 TFLOP/s); 56 and 150 MB of points are 13 and 35 us. Weights of 16 kB a tile and layer, the parts
// (32 kB) and the hidden values (48 kB) pass the second-level cache: 1.3 GB, 0.25 ms, at the same time.
#pragma once
#include <cmath>

#include "../math/hit.h"  // most_of
#include "grid.h"
#include "mlp.h"
#include "mlp_products.h"

namespace refdgs::cuda {

// [rows][kMlpSide], rows of 64 used.
template <class S> struct MlpShared {
  alignas(4 * sizeof(S)) S a[kHidden * kMlpSide];
  alignas(4 * sizeof(S)) S b[kHidden * kMlpSide];
};

template <class S> struct MlpTile {
  const MlpCall<S>& f;
  int64_t begin;
  int points;

  REFDGS_KERNEL MlpTile(const MlpCall<S>& call, int64_t tile) : f(call), begin(tile * kMlpPoints) {
    const int64_t left = call.count() - begin;
    points = left < kMlpPoints ? int(left) : kMlpPoints;
  }

  template <class Thread> REFDGS_KERNEL void load_x(Thread& t, S* to) const {
    for (int i = t.thread(); i < padded(f.shape.inputs) * kMlpPoints; i += kMlpThreads) {
      const int c = i / kMlpPoints, p = i % kMlpPoints;
      const bool there = p < points && c < f.shape.inputs;
      to[c * kMlpSide + p] = there ? f.x_at(begin + p, c) : S(0);
    }
  }

  // Products go through units by steps of this many: zeros fill the last step.
  static REFDGS_HD int padded(int units) { return (units + kMlpStep - 1) / kMlpStep * kMlpStep; }

  // Layer l's weights as [input][output], zeros for what is not there.
  template <class Thread> REFDGS_KERNEL void load_weights(Thread& t, int l, S* to) const {
    const int inputs = f.inputs(l), outputs = f.outputs(l);
    const int rows = padded(inputs);
    for (int i = t.thread(); i < rows * kHidden; i += kMlpThreads) {
      const int o = i / rows, k = i % rows;
      to[k * kMlpSide + o] = o < outputs && k < inputs ? f.net.weights[l][o * inputs + k] : S(0);
    }
  }
  // And as [output][input].
  template <class Thread> REFDGS_KERNEL void load_transposed(Thread& t, int l, S* to) const {
    const int inputs = f.inputs(l), outputs = f.outputs(l);
    for (int i = t.thread(); i < padded(outputs) * kHidden; i += kMlpThreads) {
      const int o = i / kHidden, k = i % kHidden;
      to[o * kMlpSide + k] = k < inputs && o < outputs ? f.net.weights[l][o * inputs + k] : S(0);
    }
  }

  // s.a: the inputs; becomes the outputs of hidden layer l, which go to `keep` too if it is not null.
  template <class Product, class Thread>
  REFDGS_KERNEL void hidden_layer(Thread& t, MlpShared<S>& s, int l, S* keep) const {
    load_weights(t, l, s.b);
    t.sync();
    const Product sum(t, s.a, s.b, padded(f.inputs(l)));
    t.sync();
    sum.each(t, [&](int m, int n, S value) {
      const S y = value + f.net.bias[l][n], h = y > 0 ? y : S(0);
      s.a[n * kMlpSide + m] = h;
      if (keep) keep[n * kMlpPoints + m] = h;
    });
    t.sync();
  }
};

// Product: FmaProduct or MmaProduct. A thread: one point and one output at the end, 64 x 4.
template <class S, template <class> class Product> struct MlpForward {
  static constexpr int kThreads = kMlpThreads;
  using Shared = MlpShared<S>;
  MlpCall<S> f;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared& s) const {
    const MlpTile<S> tile(f, t.block());
    if (tile.points <= 0) return;
    tile.load_x(t, s.a);
    for (int l = 0; l < f.shape.hidden_layers; ++l) tile.template hidden_layer<Product<S>>(t, s, l, nullptr);
    const int p = t.thread() % kMlpPoints, o = t.thread() / kMlpPoints, last = f.shape.hidden_layers;
    if (p >= tile.points || o >= f.shape.outputs) return;
    S y = f.net.bias[last][o];
    for (int k = 0; k < kHidden; ++k) y += f.net.weights[last][o * kHidden + k] * s.a[k * kMlpSide + p];
    if (f.points.has_exp) y = y < f.cap ? std::exp(y) : y >= f.cap ? f.largest : y;  // a NaN stays one
    f.out[(tile.begin + p) * f.shape.outputs + o] = y;
  }
};

template <class S, template <class> class Product> struct MlpBackward {
  static constexpr int kThreads = kMlpThreads, kResident = 3;
  using Shared = MlpShared<S>;
  MlpCall<S> f;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared& s) const {
    const int64_t tiles = (f.count() + kMlpPoints - 1) / kMlpPoints;
    S* part = f.parts + int64_t(t.block()) * f.numbers();
    S* hidden = f.hidden + int64_t(t.block()) * f.shape.hidden_layers * kHidden * kMlpPoints;
    for (int i = t.thread(); i < f.numbers(); i += kThreads) part[i] = 0;
    for (int64_t index = t.block(); index < tiles; index += f.blocks) {
      const MlpTile<S> tile(f, index);
      t.sync();
      tile.load_x(t, s.a);
      for (int l = 0; l < f.shape.hidden_layers; ++l)
        tile.template hidden_layer<Product<S>>(t, s, l, hidden + int64_t(l) * kHidden * kMlpPoints);
      load_v_out(t, tile, s.a);
      for (int l = f.shape.hidden_layers; l >= 0; --l) {
        load_inputs(t, tile, l, hidden, s.b);
        t.sync();
        add_weights(t, l, s, part + f.start(l));
        t.sync();
        if (l || f.v_x.count) inputs_vjp(t, tile, l, s, hidden);
      }
    }
  }

  // [output][point], zeros where there is no point.
  template <class Thread> REFDGS_KERNEL void load_v_out(Thread& t, const MlpTile<S>& tile, S* to) const {
    for (int i = t.thread(); i < tile.padded(f.shape.outputs) * kMlpPoints; i += kThreads) {
      const int o = i / kMlpPoints, p = i % kMlpPoints;
      S g = 0;
      if (p < tile.points && o < f.shape.outputs) {
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

  // Adds sum over points of a[output][point] b[input][point], and of a for the bias.
  template <class Thread> REFDGS_KERNEL void add_weights(Thread& t, int l, const Shared& s, S* part) const {
    const int outputs = f.outputs(l), inputs = f.inputs(l);
    const typename Product<S>::Outer sum(t, s.a, s.b, outputs, inputs);
    sum.each(t, [&](int m, int n, S value) {
      if (m < outputs && n < inputs) part[m * inputs + n] += value;
    });
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
    const Product<S> sum(t, s.a, s.b, tile.padded(f.outputs(l)));
    t.sync();
    sum.each(t, [&](int m, int n, S value) {
      if (l)
        s.a[n * kMlpSide + m] = hidden[(int64_t(l - 1) * kHidden + n) * kMlpPoints + m] > 0 ? value : S(0);
      else if (m < tile.points && n < f.shape.inputs)
        f.set_v_x(tile.begin + m, n, value);
    });
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
