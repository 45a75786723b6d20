// The kernels of photo.h, a thread a pixel, and their launches on any queue; included by one file for each.
//
// Bytes a pixel: 4 in and 12 out for the target, 5 in and 4 out for the entropy: 10 and 6 MB at 800 x 800, floors of 2.4
// and 1.3 us at 4.3 TB/s; two logarithms a pixel do not count. In plain torch both took 11 launches and 90 bytes.
#include <cmath>

#include "grid.h"
#include "photo.h"
#include "raster_sums.h"

namespace refdgs::cuda {

template <class S> REFDGS_KERNEL S unit_byte(uint8_t b) { return S(b) * S(1.0 / 255); }

template <class S> struct ComposeTarget {
  static constexpr int kThreads = kPhotoThreads;
  using Shared = Nothing;
  Photo photo;
  const S* backdrop;
  S* out;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared&) const {
    const int64_t plane = int64_t(photo.width) * photo.height, p = int64_t(t.block()) * kThreads + t.thread();
    if (p >= plane) return;
    const S m = photo.mask ? unit_byte<S>(photo.mask[p]) : S(1), around = 1 - m;
    for (int c = 0; c < 3; ++c)
      out[c * plane + p] = unit_byte<S>(photo.rgb[c * plane + p]) * m + around * backdrop[c];
  }
};

template <class S> struct MaskEntropies {
  static constexpr int kThreads = kPhotoThreads, kWarps = kThreads / kWarp;
  struct Shared {
    S sums[kWarps];
  };
  MaskEntropy<S> in;
  S* parts;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared& s) const {
    const int64_t p = int64_t(t.block()) * kThreads + t.thread();
    S sum = p < int64_t(in.width) * in.height ? entropy(p) : S(0);
    sum = sum_lanes<1>(t, &sum);
    if (t.lane() == 0) s.sums[t.warp()] = sum;
    t.sync();
    if (t.thread()) return;
    sum = 0;
    for (int w = 0; w < kWarps; ++w) sum += s.sums[w];
    parts[t.block()] = sum;
  }

  // A pixel's part of the loss; writes its gradient. An alpha that is NaN makes the loss NaN.
  REFDGS_KERNEL S entropy(int64_t p) const {
    const S low = S(1e-4), high = S(1) - S(1e-4), m = unit_byte<S>(in.mask[p]);
    const S alpha = in.alpha.data[p / in.width * in.alpha.row + p % in.width * in.alpha.column];
    const S a = alpha < low ? low : alpha > high ? high : alpha, b = 1 - a;
    if (in.v_alpha) {
      const S slope = in.scale * (b * m - a * (1 - m)) / (a * b);
      in.v_alpha[p] = low <= alpha && alpha <= high ? -slope : S(0);
    }
    return -in.scale * (m * std::log(a) + (1 - m) * std::log(b));
  }
};

template <class S, class Queue> void composited(const Queue& q, const Photo& photo, const S* backdrop, S* out) {
  q.run(blocks_for(int64_t(photo.width) * photo.height, kPhotoThreads), ComposeTarget<S>{photo, backdrop, out});
}

template <class S, class Queue> void mask_entropy(const Queue& q, const MaskEntropy<S>& in, S* parts, S* loss) {
  const int64_t blocks = blocks_for(int64_t(in.width) * in.height, kPhotoThreads);
  q.run(blocks, MaskEntropies<S>{in, parts});
  if (loss) q.run(1, SumRows<S>{parts, blocks, 1, loss});
}

#define REFDGS_PHOTO(S, Queue)                                                       \
  template void composited<S, Queue>(const Queue&, const Photo&, const S*, S*);      \
  template void mask_entropy<S, Queue>(const Queue&, const MaskEntropy<S>&, S*, S*);

}  // namespace refdgs::cuda
