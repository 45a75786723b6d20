// A block compares one 16x16 tile of one channel: it loads the tile with a border of 5, blurs the five moments down
// and then across in shared memory, and writes SSIM's slopes by (mean of x, of xx, of xy). A second kernel blurs those
// three the same way, which is the adjoint, and adds L1's sign. See ops/image_loss.inl for the formulas.
//
// Bytes a pixel and channel: 8 in and 12 out, then 12 + 8 in and 4 out, with borders served by the caches: 44, so
// 84 MB for 800 x 800 x 3: a floor of 20 us at 4.3 TB/s. Arithmetic: 5 and 3 blurs of 22 taps, some 270 flop with the
// borders: 0.52 GFLOP, 8 us at 67 TFLOP/s.
#pragma once
#include "grid.h"
#include "image_loss.h"
#include "raster_sums.h"

namespace refdgs::cuda {

constexpr int kLossWide = kLossTile + 2 * kLossReach;

// A block's tile; `border` indexes the tile with its border.
template <class S> struct LossPlace {
  int channel, left, top, x, y;
  bool inside;
  template <class Thread> REFDGS_KERNEL LossPlace(Thread& t, const LossCall<S>& f) {
    const int tile = t.block() % (f.across() * f.down());
    channel = t.block() / (f.across() * f.down());
    left = tile % f.across() * kLossTile, top = tile / f.across() * kLossTile;
    x = left + t.thread() % kLossTile, y = top + t.thread() / kLossTile;
    inside = x < f.width && y < f.height;
  }
};

// load(i, x, y) for every place of the tile and its border that is in the image; i: its place in a [wide][wide] array.
template <class S, class Thread, class Load>
REFDGS_KERNEL void each_bordered(Thread& t, const LossCall<S>& f, const LossPlace<S>& p, Load load) {
  for (int i = t.thread(); i < kLossWide * kLossWide; i += kLossTile * kLossTile) {
    const int x = p.left + i % kLossWide - kLossReach, y = p.top + i / kLossWide - kLossReach;
    load(i, x, y, x >= 0 && y >= 0 && x < f.width && y < f.height);
  }
}

template <class S> REFDGS_KERNEL S element(const Image<S>& image, int x, int y, int channel) {
  return image.data[y * image.row + x * image.column + channel * image.channel];
}

template <class S> REFDGS_KERNEL S weight_at(const LossCall<S>& f, int x, int y) {
  return f.weight ? f.weight[int64_t(y) * f.width + x] : S(1);
}

template <class S> struct CompareTiles {
  static constexpr int kThreads = kLossTile * kLossTile, kWarps = kThreads / kWarp;
  struct Shared {
    S x[kLossWide * kLossWide], y[kLossWide * kLossWide];
    S blurred[5][kLossTile * kLossWide];
    S sums[kWarps][kLossSums];
  };
  LossCall<S> f;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared& s) const {
    const LossPlace<S> p(t, f);
    each_bordered(t, f, p, [&](int i, int x, int y, bool inside) {
      s.x[i] = inside ? element(f.image, x, y, p.channel) : S(0);
      s.y[i] = inside ? element(f.target, x, y, p.channel) : S(0);
    });
    t.sync();
    for (int i = t.thread(); i < kLossTile * kLossWide; i += kThreads) {
      S m[5] = {};
      for (int k = 0; k < kLossTaps; ++k) {
        const S x = s.x[i + k * kLossWide], y = s.y[i + k * kLossWide], wx = f.taps[k] * x, wy = f.taps[k] * y;
        m[0] += wx, m[1] += wy, m[2] += wx * x, m[3] += wy * y, m[4] += wx * y;
      }
      for (int q = 0; q < 5; ++q) s.blurred[q][i] = m[q];
    }
    t.sync();
    S sums[kLossSums] = {};
    if (p.inside) compare(t, s, p, sums);
    const S total = sum_lanes<kLossSums>(t, sums);
    if (t.lane() < kLossSums) s.sums[t.warp()][t.lane()] = total;
    t.sync();
    if (t.thread() >= kLossSums) return;
    S sum = 0;
    for (int w = 0; w < kWarps; ++w) sum += s.sums[w][t.thread()];
    f.parts[kLossSums * int64_t(t.block()) + t.thread()] = sum;
  }

  template <class Thread>
  REFDGS_KERNEL void compare(Thread& t, const Shared& s, const LossPlace<S>& p, S* sums) const {
    const int tx = t.thread() % kLossTile, ty = t.thread() / kLossTile;
    S m[5] = {};
    for (int k = 0; k < kLossTaps; ++k)
      for (int q = 0; q < 5; ++q) m[q] += f.taps[k] * s.blurred[q][ty * kLossWide + tx + k];
    const S c1 = S(1e-4), c2 = S(9e-4), mx = m[0], my = m[1], w = weight_at(f, p.x, p.y);
    const S means = mx * mx + my * my, a1 = 2 * mx * my + c1, a2 = 2 * (m[4] - mx * my) + c2;
    const S spread = m[2] + m[3] - means;
    const S ib1 = 1 / (means + c1), ib2 = 1 / ((spread > 0 ? spread : S(0)) + c2), ssim = a1 * a2 * ib1 * ib2;
    const S by_xx = -ssim * ib2, by_xy = 2 * a1 * ib1 * ib2;
    const S by_mx = 2 * (my * a2 * ib1 * ib2 - mx * ssim * ib1 - mx * by_xx) - my * by_xy;
    const int middle = (ty + kLossReach) * kLossWide + tx + kLossReach;
    const S d = s.x[middle] - s.y[middle];
    sums[0] = w * std::fabs(d), sums[1] = w * ssim, sums[2] = w * d * d;
    const int64_t plane = int64_t(f.width) * f.height, at = p.channel * plane + int64_t(p.y) * f.width + p.x;
    if (f.map) f.map[at] = ssim;
    if (!f.slopes) return;
    const int64_t all = plane * f.channels;
    f.slopes[at] = w * by_mx, f.slopes[all + at] = w * by_xx, f.slopes[2 * all + at] = w * by_xy;
  }
};

// One block: the sums of all parts, then the loss. With nothing that counts, nothing is lost.
template <class S> struct FinishLoss {
  static constexpr int kThreads = SumRows<S>::kThreads;
  using Shared = typename SumRows<S>::Shared;
  LossCall<S> f;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared& s) const {
    SumRows<S>{f.parts, f.blocks(), kLossSums, f.sums}(t, s);
    t.sync();
    if (t.thread() || !f.loss) return;
    const S each = f.unit();
    *f.loss = each > 0 ? each * (f.l1_share * f.sums[0] + f.ssim_share * f.sums[1]) - f.ssim_share : S(0);
    *f.error = each > 0 ? each * f.sums[2] : S(0);
  }
};

template <class S> struct LossGradient {
  static constexpr int kThreads = kLossTile * kLossTile;
  struct Shared {
    S slopes[3][kLossWide * kLossWide];
    S blurred[3][kLossTile * kLossWide];
  };
  LossCall<S> f;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared& s) const {
    const LossPlace<S> p(t, f);
    const int64_t plane = int64_t(f.width) * f.height, all = plane * f.channels;
    each_bordered(t, f, p, [&](int i, int x, int y, bool inside) {
      const int64_t at = p.channel * plane + int64_t(y) * f.width + x;
      for (int q = 0; q < 3; ++q) s.slopes[q][i] = inside ? f.slopes[q * all + at] : S(0);
    });
    t.sync();
    for (int i = t.thread(); i < kLossTile * kLossWide; i += kThreads)
      for (int q = 0; q < 3; ++q) {
        S sum = 0;
        for (int k = 0; k < kLossTaps; ++k) sum += f.taps[k] * s.slopes[q][i + k * kLossWide];
        s.blurred[q][i] = sum;
      }
    t.sync();
    if (!p.inside) return;
    S g[3] = {};
    const int first = t.thread() / kLossTile * kLossWide + t.thread() % kLossTile;
    for (int k = 0; k < kLossTaps; ++k)
      for (int q = 0; q < 3; ++q) g[q] += f.taps[k] * s.blurred[q][first + k];
    const S x = element(f.image, p.x, p.y, p.channel), y = element(f.target, p.x, p.y, p.channel), d = x - y;
    const S sign = d > 0 ? S(1) : d < 0 ? S(-1) : S(0), each = f.unit();
    f.gradient[p.channel * plane + int64_t(p.y) * f.width + p.x] =
        each * (f.l1_share * (weight_at(f, p.x, p.y) * sign) + f.ssim_share * (g[0] + 2 * x * g[1] + y * g[2]));
  }
};

}  // namespace refdgs::cuda
