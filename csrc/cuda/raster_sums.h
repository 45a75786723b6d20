// From slots to surfels: SumSlots adds a surfel's slots, a warp a surfel and a lane four components of every fifth (4th,
// 8th) slot, so that slots are read in whole sectors, 20 at once; SurfelVjp passes the sums on to the parameters, a
// thread a surfel. E slots of 4 (12 + C) bytes in, N rows of that out and in again, 40 + 4 C bytes of gradients out: 96 +
// 37 MB at 1,000,000 entries, 130,000 surfels and 12 channels, 31 us at 4.3 TB/s; 300 flop a surfel do not count.
#pragma once
#include "../math/record.h"
#include "grid.h"
#include "raster.h"

namespace refdgs::cuda {

template <class S> struct SumSlots {
  static constexpr int kThreads = 256;
  using Shared = Nothing;
  Drawing<S> d;
  DrawingGrads<S> v;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared&) const {
    const int64_t i = int64_t(t.block()) * (kThreads / kWarp) + t.warp();
    const bool there = i < d.surfels.count && d.fits();
    const int64_t begin = there ? d.slot_start[i] : 0, end = there ? d.slot_start[i + 1] : 0;
    const int width = d.slot_width(), quads = width / 4, rows = kWarp / quads;
    const int row = t.lane() / quads, c = t.lane() % quads * 4;
    S sum[4] = {};
    for (int64_t base = begin; base < end; base += 4 * rows) {
      S got[4][4] = {};
#if defined(__CUDACC__)
#pragma unroll
#endif
      for (int k = 0; k < 4; ++k) {  // four loads on their way at once
        const int64_t slot = base + k * rows + row;
        if (row < rows && slot < end && v.activity[slot]) copy_quads<4>(got[k], v.slots + slot * width + c);
      }
      for (int k = 0; k < 4; ++k)
        for (int j = 0; j < 4; ++j) sum[j] += got[k][j];
    }
    S total[4] = {sum[0], sum[1], sum[2], sum[3]};
    for (int other = 1; other < rows; ++other)
      for (int j = 0; j < 4; ++j) total[j] += t.shuffle(sum[j], (t.lane() + other * quads) % kWarp);
    if (i < d.surfels.count && row == 0) put_quad(v.sums + i * width + c, total);
  }
};

template <class S> struct SurfelVjp {
  static constexpr int kThreads = kVjpThreads, kWarps = kThreads / kWarp;
  struct Shared {
    S pose[kWarps][12];
  };
  Drawing<S> d;
  DrawingGrads<S> v;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared& s) const {
    const int64_t i = int64_t(t.block()) * kThreads + t.thread();
    S pose[12] = {};
    if (i < d.surfels.count) pass_on(i, pose);
    if (!v.pose_parts) return;
    const S total = sum_lanes<12>(t, pose);
    if (t.lane() < 12) s.pose[t.warp()][t.lane()] = total;
    t.sync();
    if (t.thread() >= 12) return;
    S sum = 0;
    for (int w = 0; w < kWarps; ++w) sum += s.pose[w][t.thread()];
    v.pose_parts[int64_t(t.block()) * 12 + t.thread()] = sum;
  }

  REFDGS_KERNEL void pass_on(int64_t i, S* pose) const {
    const SurfelGrads<S>& out = v.out;
    const S* sums = v.sums + i * d.slot_width();
    const int channels = d.surfels.channels;
    S g[kGradHead], r[kDrawnHead];
    copy_quads<kGradHead>(g, sums);
    for (int c = 0; c < channels; ++c) out.features[i * channels + c] = sums[kGradHead + c];
    out.opacities[i] = g[9];
    out.screen[2 * i] = std::sqrt(g[0] * g[0] + g[1] * g[1]);
    out.screen[2 * i + 1] = std::sqrt(g[10] * g[10] + g[11] * g[11]);
    SurfelGrad<S> to{};
    if (d.slot_start[i + 1] > d.slot_start[i]) {
      copy_quads<kDrawnHead>(r, d.records + i * d.stride);
      to = record_vjp(d.surfels.means + 3 * i, d.surfels.quats + 4 * i, d.surfels.scales + 2 * i,
                      seen_through(d.lens, d.cam), r, g, d.normals ? sums + kGradHead + channels : nullptr);
    }
    for (int c = 0; c < 3; ++c) out.means[3 * i + c] = to.mean[c];
    for (int c = 0; c < 4; ++c) out.quats[4 * i + c] = to.quat[c];
    for (int c = 0; c < 2; ++c) out.scales[2 * i + c] = to.scale[c];
    for (int c = 0; c < 12; ++c) pose[c] = to.v_pose[c];
  }
};

// out[c] = the sum of column c of parts [rows][columns], added in double and in one fixed order: stripes of rows, then pairs of stripes.
template <class S> struct SumRows {
  static constexpr int kThreads = 256;
  struct Shared {
    double sums[kThreads];
  };
  const S* parts;
  int64_t rows;
  int columns;
  S* out;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared& s) const {
    const int c = t.thread() % columns, stripe = t.thread() / columns, stripes = kThreads / columns;
    double sum = 0;
    if (stripe < stripes) {
      REFDGS_UNROLL_4
      for (int64_t row = stripe; row < rows; row += stripes) sum += double(parts[row * columns + c]);
    }
    s.sums[t.thread()] = sum;
    t.sync();
    for (int step = kThreads / 2; step > 0; step /= 2) {  // stripes in pairs
      if (stripe < step && stripe + step < stripes) s.sums[t.thread()] += s.sums[t.thread() + step * columns];
      t.sync();
    }
    if (t.thread() < columns) out[c] = S(s.sums[c]);
  }
};

}  // namespace refdgs::cuda
