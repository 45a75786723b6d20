// Blending a tile's surfels near to far, and back. A block is a 16x16 tile, a warp 8x4 of its pixels. A warp goes
// through the tile's list 32 entries at a time: each lane tests one entry exactly against the warp's 8x4 pixels,
// and only those that reach them are blended, by all lanes, a pixel each. Records are read at the same address by
// all lanes, from the nearest cache, which the tile's 8 warps share; forward has no barrier at all.
//
// Backward walks the same list with dL/dalpha = T D - (R - w D) / (1 - alpha), D = dL/dw of a surfel, R = the sum
// of w D over it and everything behind it. A warp's sums of the 12 + C gradients of an entry go to shared memory,
// the block adds its 8 warps in order, and the entry's slot is written once: no atomics, the same bits in every
// run. SumSlots and SurfelVjp then add a surfel's slots in order and pass them on to its parameters.
//
// At 800x800, 30 pairs a pixel, 12 channels: 19 M pairs. Forward 60 flop + 2 C: 1.6 GFLOP; backward 140 + 5 C and
// 31 exchanges for each warp that an entry reaches: 4 GFLOP: floors of 25 and 60 us at 67 TFLOP/s. Bytes: maps 42 MB
// out, 84 MB in (10 and 20 us at 4.3 TB/s), slots 58 MB out and in (27 us). Bound by instructions: about half of
// the lanes of a reached 8x4 patch have a pair, and a pair costs some 110 (270) instructions.
#pragma once
#include "../math/hit.h"
#include "grid.h"
#include "raster.h"

namespace refdgs::cuda {

// Where a warp's lanes look.
template <class S> struct Patch {
  int tile, index;      // index: of the tile's 8 patches
  int left, top, x, y;  // pixels
  bool inside;

  template <class Thread> REFDGS_KERNEL Patch(Thread& t, const Drawing<S>& d)
      : tile(t.block()), index(t.warp()), left(tile % d.tiles_x * kTile + index % 2 * kPatchW),
        top(tile / d.tiles_x * kTile + index / 2 * kPatchH), x(left + t.lane() % kPatchW),
        y(top + t.lane() / kPatchW), inside(x < d.cam.width && y < d.cam.height) {}

  REFDGS_KERNEL bool is_reached(const S* record) const {
    return reaches(record, S(left) + S(0.5), S(top) + S(0.5), S(kPatchW - 1), S(kPatchH - 1));
  }
};

template <class S, int C, int X> struct DrawTiles {
  static constexpr int kThreads = kTilePixels;
  using Shared = Nothing;
  Drawing<S> d;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared&) const {
    const Patch<S> patch(t, d);
    const S x = S(patch.x) + S(0.5), y = S(patch.y) + S(0.5);
    const int end = d.tile_start[patch.tile + 1];
    S sum[C] = {}, T = 1, depth = 0, median = 0, distortion = 0, m1 = 0, m2 = 0;
    bool alive = patch.inside;
    int e = d.tile_start[patch.tile];
    for (; e < end && t.any(alive); e += kWarp) {
      const int surfel = e + t.lane() < end ? d.entries[e + t.lane()].surfel : -1;
      const bool reached = surfel >= 0 && patch.is_reached(d.records + int64_t(surfel) * d.stride);
      for (uint32_t list = t.ballot(reached); list; list &= list - 1) {
        const S* record = d.records + int64_t(t.shuffle(surfel, lowest_bit(list))) * d.stride;
        S r[kContour];
        copy_quads<kContour>(r, record);
        const PixelHit<S> h = pixel_hit(r, x, y, d.cam.near);
        if (h.visible && alive) {
          const S alpha = least_of(r[9] * exp_of(h.rho * S(-0.5)), S(kMaxAlpha)), next_T = T - T * alpha;
          if (next_T < S(kMinTransmittance)) {
            alive = false;
          } else {
            const S w = alpha * T;
            S channel[C];
            copy_quads<C>(channel, record + kRecordHead);
            for (int c = 0; c < C; ++c) sum[c] += channel[c] * w;
            if (X >= 1) {
              depth += w * h.z;
              if (T > S(0.5) && next_T <= S(0.5)) median = h.z;
            }
            if (X >= 2) {
              const S m = d.cam.near * inverse_of(h.z);
              distortion += w * (m * m * (1 - T) + m2 - 2 * m * m1);
              m1 += w * m;
              m2 += w * m * m;
            }
            T = next_T;
          }
        }
        if (!t.any(alive)) break;
      }
    }
    if (t.lane() == 0) d.patch_stop[patch.tile * kPatches + patch.index] = e < end ? e : end;
    if (!patch.inside) return;
    const int64_t plane = int64_t(d.cam.width) * d.cam.height, p = int64_t(patch.y) * d.cam.width + patch.x;
    S* to = d.maps + p;
    for (int c = 0; c < C; ++c) to[c * plane] = sum[c];
    to[C * plane] = 1 - T;
    if (X >= 1) to[(C + 1) * plane] = depth, to[(C + 2) * plane] = median;
    if (X >= 2) to[(C + 3) * plane] = distortion, d.moments[p] = m1, d.moments[plane + p] = m2;
  }
};

// What backward knows of a pixel.
template <class S, int C, int X> struct Replayed {
  S g[C + 4];         // of the loss by the channels, alpha, depth, median, distortion
  S T = 1, R = 0, A = 0, m1 = 0, m2 = 0;
  bool alive;

  REFDGS_KERNEL Replayed(const Drawing<S>& d, const Image<S> (*v)[kShares], int px, int py, bool inside) : alive(inside) {
    for (int c = 0; c < C + 4; ++c) g[c] = 0;
    if (!inside) return;
    const int64_t plane = int64_t(d.cam.width) * d.cam.height, p = int64_t(py) * d.cam.width + px;
    const int features = d.surfels.channels;
#if defined(__CUDACC__)
#pragma unroll 1
#endif
    for (int k = 0; k < kShares; ++k) {
      const auto read = [&](Plane kind, int c) {
        const Image<S>& image = v[kind][k];
        return image.data ? image.data[py * image.row + px * image.column + c * image.channel] : S(0);
      };
      for (int c = 0; c < C; ++c) {
        if (c < features) g[c] += read(kFeatures, c);
        else if (d.normals && c < features + 3) g[c] += read(kNormal, c - features);
      }
      g[C] += read(kAlpha, 0);
      if (X >= 1) g[C + 1] += read(kDepth, 0), g[C + 2] += read(kMedian, 0);
      if (X >= 2) g[C + 3] += read(kDistortion, 0);
    }
    for (int c = 0; c < C + (X >= 1 ? 2 : 1); ++c) R += d.maps[c * plane + p] * g[c];
    if (X >= 2) {
      R += 2 * d.maps[(C + 3) * plane + p] * g[C + 3];
      A = d.maps[C * plane + p], m1 = d.moments[p], m2 = d.moments[plane + p];
    }
  }

  // One surfel at this pixel; G: its gradients, all zero before. True if there are any.
  REFDGS_KERNEL bool blend(const S* record, S x, S y, S near, S* G) {
    S r[kContour];
    copy_quads<kContour>(r, record);
    const PixelHit<S> h = pixel_hit(r, x, y, near);
    if (!h.visible || !alive) return false;
    const S bump = exp_of(h.rho * S(-0.5)), raw = r[9] * bump, alpha = least_of(raw, S(kMaxAlpha));
    const S next_T = T - T * alpha;
    if (next_T < S(kMinTransmittance)) {
      alive = false;
      return false;
    }
    const S w = alpha * T;
    S channel[C], D = g[C], g_z = 0;
    copy_quads<C>(channel, record + kRecordHead);
    for (int c = 0; c < C; ++c) {
      D += channel[c] * g[c];
      G[kGradHead + c] = w * g[c];
    }
    if (X >= 1) {
      D += h.z * g[C + 1];
      g_z = w * g[C + 1] + (T > S(0.5) && next_T <= S(0.5) ? g[C + 2] : S(0));
    }
    if (X >= 2) {
      const S iz = inverse_of(h.z), m = near * iz;
      D += g[C + 3] * (m * m * A + m2 - 2 * m * m1);
      g_z -= 2 * w * g[C + 3] * (m * A - m1) * m * iz;
    }
    R -= w * D;
    const S g_alpha = raw <= S(kMaxAlpha) ? T * D - R * inverse_of(1 - alpha) : S(0);
    G[9] = g_alpha * bump;
    hit_vjp(h, r, S(-0.5) * g_alpha * alpha, g_z, G);
    T = next_T;
    return true;
  }
};

template <class S, int C, int X> struct DrawTilesBwd {
  static constexpr int kThreads = kTilePixels, kWidth = kGradHead + C;
  static constexpr int kResident = C <= 8 ? 3 : 2;  // more would spill
  struct Shared {
    S part[kPatches][kWarp][kWidth];
    uint32_t touched[kPatches];
  };
  Drawing<S> d;
  DrawingGrads<S> v;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared& s) const {
    const Patch<S> patch(t, d);
    const S x = S(patch.x) + S(0.5), y = S(patch.y) + S(0.5);
    const int end = d.tile_start[patch.tile + 1], *stops = d.patch_stop + patch.tile * kPatches;
    const int stop = stops[patch.index];
    int last = 0;
    for (int k = 0; k < kPatches; ++k) last = most_of(last, int(stops[k]));
    Replayed<S, C, X> pixel(d, v.maps, patch.x, patch.y, patch.inside);
    int e = d.tile_start[patch.tile];
    for (; e < last; e += kWarp) {
      uint32_t touched = 0;
      if (e < stop) {
        const int surfel = e + t.lane() < stop ? d.entries[e + t.lane()].surfel : -1;
        const bool reached = surfel >= 0 && patch.is_reached(d.records + int64_t(surfel) * d.stride);
        for (uint32_t list = t.ballot(reached); list; list &= list - 1) {
          const int k = lowest_bit(list);
          const S* record = d.records + int64_t(t.shuffle(surfel, k)) * d.stride;
          S G[kWidth] = {};
          if (!t.any(pixel.blend(record, x, y, d.cam.near, G))) continue;
          const S total = sum_lanes<kWidth>(t, G);
          if (t.lane() < kWidth) s.part[patch.index][k][t.lane()] = total;
          touched |= 1u << k;
        }
      }
      if (t.lane() == 0) s.touched[patch.index] = touched;
      t.sync();
      add_patches(t, s, e, least_of(end - e, kWarp));
      t.sync();
    }
    for (e += t.thread(); e < end; e += kThreads) v.activity[d.entries[e].slot] = 0;
  }

  // Writes the slots of n entries from e on.
  template <class Thread> REFDGS_KERNEL void add_patches(Thread& t, const Shared& s, int e, int n) const {
    for (int i = t.thread(); i < n * kWidth; i += kThreads) {
      const int k = i / kWidth, c = i % kWidth;
      const int64_t slot = d.entries[e + k].slot;
      S sum = 0;
      bool any = false;
      for (int p = 0; p < kPatches; ++p) {
        if (!(s.touched[p] >> k & 1)) continue;
        sum += s.part[p][k][c];
        any = true;
      }
      if (any) v.slots[slot * kWidth + c] = sum;
      if (c == 0) v.activity[slot] = any;
    }
  }
};

}  // namespace refdgs::cuda
