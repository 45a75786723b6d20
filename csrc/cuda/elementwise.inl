// The kernels of elementwise.h, and their launches on any queue; included by one file for each. All are bound by memory
// and by their launch, which is what they save: at 4.3 TB/s
//   total        some 10,000 parts: 40 KB; one block, 5 us because it is one
//   image_mean   4 bytes a pixel: 3 MB at 800 x 800, 0.6 us
//   activated    28 + 28 bytes a surfel that carries 4 numbers: 7 MB for 130,000, 1.7 us; back 84 bytes, 2.5 us
//   observe      28 bytes a surfel: 4 MB, 0.9 us
//   damped       36 bytes in, 12 out a covered pixel: 15 MB for 320,000, 3.6 us
#include <cmath>

#include "../math/shade.h"
#include "elementwise.h"
#include "grid.h"

namespace refdgs::cuda {

// One block. A thread adds every kThreads-th part of each term, then halves of the threads' sums are added.
template <class S> struct AddTerms {
  static constexpr int kThreads = 512;
  struct Shared {
    double sums[kThreads];
  };
  Terms<S> in;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared& s) const {
    double sum = 0;
    for (int k = 0; k < in.terms; ++k)
      for (int64_t i = t.thread(); i < in.count[k]; i += kThreads) sum += double(in.parts[k][i]);
    s.sums[t.thread()] = sum;
    for (int half = kThreads / 2; half; half /= 2) {
      t.sync();
      if (t.thread() < half) s.sums[t.thread()] += s.sums[t.thread() + half];
    }
    if (t.thread() == 0) *in.out = S(s.sums[0]);
  }
};

// A block: kMeanEach numbers, a thread every kThreads-th.
template <class S> struct MeanParts {
  static constexpr int kThreads = 256, kWarps = kThreads / kWarp;
  struct Shared {
    S sums[kWarps];
  };
  ImageMean<S> in;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared& s) const {
    const int64_t plane = in.width * in.height, begin = int64_t(t.block()) * kMeanEach;
    S sum = 0;
    for (int64_t p = begin + t.thread(); p < begin + kMeanEach && p < plane; p += kThreads)
      if (!in.pixels || in.pixels[p / in.width] >= 0)
        sum += in.image.data[p / in.width * in.image.row + p % in.width * in.image.column];
    sum = sum_lanes<1>(t, &sum);
    if (t.lane() == 0) s.sums[t.warp()] = sum;
    t.sync();
    if (t.thread()) return;
    sum = 0;
    for (int w = 0; w < kWarps; ++w) sum += s.sums[w];
    in.parts[t.block()] = in.scale * sum;
    if (t.block() == 0) *in.slope = in.scale;
  }
};

// A thread: one surfel.
template <class S> struct Activate {
  static constexpr int kThreads = 256;
  using Shared = Nothing;
  Activation<S> in;

  REFDGS_KERNEL static S sigmoid(S x) { return 1 / (1 + std::exp(-x)); }
  REFDGS_KERNEL static S curved(int curve, S x) {
    if (curve == kTanh) return std::tanh(x);
    return curve == kSigmoid ? sigmoid(x) : std::exp(x > S(kBrightest) ? S(kBrightest) : x) / 5;
  }
  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared&) const {
    const int64_t i = int64_t(t.block()) * kThreads + t.thread();
    if (i >= in.count) return;
    for (int c = 0; c < 2; ++c) in.scales[2 * i + c] = std::exp(in.log_scales[2 * i + c]);
    in.opacities[i] = sigmoid(in.raw_opacities[i]);
    S* to = in.carried + i * in.channels;
    for (int k = 0; k < kTables; ++k) {  // as many times as there are tables at most, so that k is known to compilers
      if (k >= in.tables) break;
      const S* from = in.raw[k] + i * in.columns[k];
      for (int c = 0; c < in.columns[k]; ++c) *to++ = curved(in.curve[k], from[c]);
    }
  }
};

template <class S> struct ActivateBwd {
  static constexpr int kThreads = 256;
  using Shared = Nothing;
  Activation<S> in;
  ActivationGrads<S> g;

  // Of a curve that has come to y at x.
  REFDGS_KERNEL static S slope(int curve, S x, S y) {
    if (curve == kTanh) return 1 - y * y;
    return curve == kSigmoid ? y * (1 - y) : x <= S(kBrightest) ? y : S(0);
  }
  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared&) const {
    const int64_t i = int64_t(t.block()) * kThreads + t.thread();
    if (i >= in.count) return;
    for (int c = 0; c < 2; ++c) g.v_log_scales[2 * i + c] = g.v_scales[2 * i + c] * in.scales[2 * i + c];
    g.v_raw_opacities[i] = g.v_opacities[i] * slope(kSigmoid, 0, in.opacities[i]);
    int64_t at = i * in.channels;
    for (int k = 0; k < in.tables; ++k)
      for (int c = 0; c < in.columns[k]; ++c, ++at) {
        const int64_t own = i * in.columns[k] + c;
        g.v_raw[k][own] = g.v_carried[at] * slope(in.curve[k], in.raw[k][own], in.carried[at]);
      }
  }
};

// A thread: one surfel of one set.
template <class S> struct Observe {
  static constexpr int kThreads = 256;
  using Shared = Nothing;
  Observation<S> in;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared&) const {
    if (in.misfit && *in.misfit != 0) return;
    int64_t i = int64_t(t.block()) * kThreads + t.thread();
    int k = 0;
    while (k < in.sets && i >= in.set[k].count) i -= in.set[k++].count;
    if (k == in.sets || !(in.set[k].radii[i] > 0)) return;
    in.set[k].sum[i] += in.set[k].gradients[2 * i] * in.scale;
    in.set[k].seen[i] += 1;
  }
};

// A thread: one covered pixel.
template <class S> struct Damp {
  static constexpr int kThreads = 256;
  using Shared = Nothing;
  Damping<S> in;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared&) const {
    const int64_t i = int64_t(t.block()) * kThreads + t.thread();
    if (i >= in.count) return;
    const auto at = [&](const Rows<const S>& rows, int c) { return rows.data[i * rows.row + c * rows.column]; };
    const S mirrored = at(in.mirrored, 0) + at(in.mirrored, 1) + at(in.mirrored, 2);
    const S all = mirrored + (at(in.diffuse, 0) + at(in.diffuse, 1) + at(in.diffuse, 2));
    const S trust = min_of(mirrored / max_of(all, S(kDark)) / in.share, S(1));
    for (int c = 0; c < 3; ++c) in.out[c * in.count + i] = at(in.grad, c) * trust;
  }
};

template <class S, class Queue> void total(const Queue& q, const Terms<S>& in) { q.run(1, AddTerms<S>{in}); }

template <class S, class Queue> void image_mean(const Queue& q, const ImageMean<S>& in) {
  const int64_t blocks = blocks_for(in.width * in.height, kMeanEach);
  q.run(blocks ? blocks : 1, MeanParts<S>{in});
}

template <class S, class Queue> void activated(const Queue& q, const Activation<S>& in) {
  q.run(blocks_for(in.count, Activate<S>::kThreads), Activate<S>{in});
}

template <class S, class Queue>
void activated_bwd(const Queue& q, const Activation<S>& in, const ActivationGrads<S>& g) {
  q.run(blocks_for(in.count, ActivateBwd<S>::kThreads), ActivateBwd<S>{in, g});
}

template <class S, class Queue> void observe(const Queue& q, const Observation<S>& in) {
  int64_t count = 0;
  for (int k = 0; k < in.sets; ++k) count += in.set[k].count;
  q.run(blocks_for(count, Observe<S>::kThreads), Observe<S>{in});
}

template <class S, class Queue> void damped(const Queue& q, const Damping<S>& in) {
  q.run(blocks_for(in.count, Damp<S>::kThreads), Damp<S>{in});
}

#define REFDGS_ELEMENTWISE(S, Queue)                                                                          \
  template void total<S, Queue>(const Queue&, const Terms<S>&);                                               \
  template void image_mean<S, Queue>(const Queue&, const ImageMean<S>&);                                      \
  template void activated<S, Queue>(const Queue&, const Activation<S>&);                                      \
  template void activated_bwd<S, Queue>(const Queue&, const Activation<S>&, const ActivationGrads<S>&);       \
  template void observe<S, Queue>(const Queue&, const Observation<S>&);                                       \
  template void damped<S, Queue>(const Queue&, const Damping<S>&);

}  // namespace refdgs::cuda
