// Blending a patch's surfels near to far, and back. A warp is a patch of 8x4 pixels, which has a list of its own, so
// warps need nothing of each other and there are no barriers. A warp brings the records of a chunk of its list to
// shared memory, in whole sectors, and all lanes blend one after the other, a pixel each.
//
// Backward walks the same list with dL/dalpha = T D - (R - w D) / (1 - alpha), D = dL/dw of a surfel, R = the sum
// of w D over it and everything behind it. Of every surfel and pixel six or seven numbers go to shared memory
// (Passed). After eight surfels lanes change sides: four lanes take a surfel, a row of pixels each, and make its
// 12 + C sums: an eighth of the exchanges that sums over lanes take, and the products with dx and dy only once. A slot
// is written once, as whole sectors: no atomics, the same bits in every run. SumSlots and SurfelVjp then add a surfel's
// slots in order and pass them on to its parameters.
//
// At 800x800, 1,000,000 entries of patches, 12 channels: 32 M pairs of pixel and surfel, about half of them visible.
// Instructions of a warp for an entry: forward 75 + C, backward 85 + 2 C and for its part in the sums 35 + C: 87 M and
// 156 M, 120 and 220 us at 3 a cycle and SM. Bytes: maps 42 MB out, 84 MB in (10 and 20 us at 4.3 TB/s), records
// 96 an entry in (22 us, most of it from L2), slots 96 out (22 us).
#pragma once
#include "../math/hit.h"
#include "grid.h"
#include "raster.h"

namespace refdgs::cuda {

// Registers are limited to what lets as many blocks reside as shared memory does, where that is large.
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ == 900
constexpr bool kRoomy = true;
#else
constexpr bool kRoomy = false;
#endif

// Where a warp's lanes look.
template <class S> struct Patch {
  int index, left, top, x, y;  // pixels
  bool inside;

  template <class Thread> REFDGS_KERNEL Patch(Thread& t, const Drawing<S>& d, int warps)
      : index(t.block() * warps + t.warp()), left(index / kPatches % d.tiles_x * kTile + index % 2 * kPatchW),
        top(index / kPatches / d.tiles_x * kTile + index % kPatches / 2 * kPatchH), x(left + t.lane() % kPatchW),
        y(top + t.lane() / kPatchW), inside(x < d.cam.width && y < d.cam.height) {}
};

// Brings the first `used` scalars of the records of n <= most surfels, each of whom one lane knows, to shared memory.
template <int used, int most, class S, class Thread>
REFDGS_KERNEL void bring_records(Thread& t, const Drawing<S>& d, int surfel, int n, S (*to)[used]) {
  constexpr int quads = used / 4;
  t.sync_warp();  // what was there has been read
#if defined(__CUDACC__)
#pragma unroll
#endif
  for (int base = 0; base < most * quads; base += kWarp) {
    const int k = (base + t.lane()) / quads, q = (base + t.lane()) % quads;
    const int64_t who = t.shuffle(surfel, k % kWarp);
    if (k >= n) continue;
    S v[4];
    copy_quads<4>(v, d.records + who * d.stride + 4 * q);
    put_quad(to[k] + 4 * q, v);
  }
  t.sync_warp();
}

template <class S, int C, int X> struct DrawTiles {
  static constexpr int kThreads = 128, kWarps = kThreads / kWarp, kUsed = kDrawnHead + C;
  static constexpr int kResident = C <= 4 ? 8 + kRoomy : C <= 8 ? 7 + kRoomy : C <= 12 ? 5 + kRoomy : 4;
  struct Shared {
    alignas(4 * sizeof(S)) S records[kWarps][kWarp][kUsed];
  };
  Drawing<S> d;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared& s) const {
    const Patch<S> patch(t, d, kWarps);
    const S x = S(patch.x) + S(0.5), y = S(patch.y) + S(0.5);
    const auto list = d.list(patch.index);
    S sum[C] = {}, T = 1, depth = 0, median = 0, distortion = 0, m1 = 0, m2 = 0;
    bool alive = patch.inside;
    S (*records)[kUsed] = s.records[t.warp()];
    int e = list.begin;
    while (e < list.end && t.any(alive)) {
      const int n = least_of(list.end - e, kWarp);
      bring_records<kUsed, kWarp>(t, d, t.lane() < n ? d.entries[e + t.lane()].surfel : 0, n, records);
      int k = 0;
#if defined(__CUDACC__)
#pragma unroll 1
#endif
      do {
        S r[kDrawnHead];
        copy_quads<kDrawnHead>(r, records[k]);
        const PixelHit<S> h = pixel_hit(r, x, y, d.cam.near);
        if (h.visible && alive) {
          const S alpha = least_of(r[9] * exp_of(h.rho * S(-0.5)), S(kMaxAlpha)), next_T = T - T * alpha;
          if (next_T < S(kMinTransmittance)) {
            alive = false;
          } else {
            const S w = alpha * T;
            S channel[C];
            copy_quads<C>(channel, records[k] + kDrawnHead);
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
        ++k;
      } while (t.any(alive) && k < n);
      e += k;
    }
    if (t.lane() == 0) d.patch_stop[patch.index] = e;
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

  // One surfel at this pixel. True if it passes on anything.
  REFDGS_KERNEL bool blend(const S* record, S x, S y, S near, Passed<S>& passed) {
    S r[kDrawnHead];
    copy_quads<kDrawnHead>(r, record);
    const PixelHit<S> h = pixel_hit(r, x, y, near);
    if (!h.visible || !alive) return false;
    const S raw = r[9] * exp_of(h.rho * S(-0.5)), alpha = least_of(raw, S(kMaxAlpha));
    const S next_T = T - T * alpha;
    if (next_T < S(kMinTransmittance)) {
      alive = false;
      return false;
    }
    const S w = alpha * T;
    S channel[C], D = g[C], g_z = 0;
    copy_quads<C>(channel, record + kDrawnHead);
    for (int c = 0; c < C; ++c) D += channel[c] * g[c];
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
    passed.w = w;
    passed.take(h, S(-0.5) * g_alpha * alpha, g_z);
    T = next_T;
    return true;
  }
};

template <class S, int C, int X> struct DrawTilesBwd {
  static constexpr int kThreads = 128, kWarps = kThreads / kWarp, kUsed = kDrawnHead + C, kWidth = kGradHead + C;
  static constexpr int kResident = !kRoomy ? 4 : C <= 4 && X == 0 ? 6 : C <= 8 ? 5 : 4;
  static constexpr int kChunk = C <= 16 ? 16 : 8, kBucket = 8;
  // A row of 8 pixels and one of nothing, so that the lanes of a surfel's rows meet other banks.
  static constexpr int kRow = kPatchW + 1, kPadded = kPatchH * kRow;
  static constexpr int kQuads = kWidth / 4, kPitch = kQuads | 1, kSlotQuads = sectors(kWidth) / 4;
  struct alignas(2 * sizeof(S)) Two {
    S on_disc, low_pass;
  };
  struct Warp {
    alignas(4 * sizeof(S)) S records[kChunk][kUsed];
    alignas(4 * sizeof(S)) S g[C / 4][kPadded][4];           // of the loss by the channels
    alignas(4 * sizeof(S)) S weights[kBucket * kPadded][4];  // w, px, py, q; then partial sums
    Two rhos[kBucket * kPadded];
    S depths[X >= 1 ? kBucket * kPadded : 1];
  };
  static_assert(kWarp * kPitch <= kBucket * kPadded, "partial sums where weights were");
  struct Shared {
    Warp warps[kWarps];
  };
  Drawing<S> d;
  DrawingGrads<S> v;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared& shared) const {
    Warp& s = shared.warps[t.warp()];
    const Patch<S> patch(t, d, kWarps);
    const S x = S(patch.x) + S(0.5), y = S(patch.y) + S(0.5);
    const auto list = d.list(patch.index);
    const int stop = list.begin < list.end ? d.patch_stop[patch.index] : 0;
    if (list.begin < stop) {
      const int place = t.lane() / kPatchW * kRow + t.lane() % kPatchW;
      Replayed<S, C, X> pixel(d, v.maps, patch.x, patch.y, patch.inside);
      for (int c = 0; c < C; c += 4) put_quad(s.g[c / 4][place], pixel.g + c);
#if defined(__CUDACC__)
#pragma unroll 1
#endif
      for (int e = list.begin; e < stop; e += kChunk) {
        const int n = least_of(stop - e, kChunk);
        const Entry entry = t.lane() < n ? d.entries[e + t.lane()] : Entry{0, 0};
        bring_records<kUsed, kChunk>(t, d, entry.surfel, n, s.records);
        uint32_t touched = 0;
#if defined(__CUDACC__)
#pragma unroll 1
#endif
        for (int first = 0; first < n; first += kBucket) {
          uint32_t held = 0;
#if defined(__CUDACC__)
#pragma unroll 1
#endif
          for (int k = 0; k < least_of(n - first, kBucket); ++k) {
            Passed<S> passed;
            if (!t.any(pixel.blend(s.records[first + k], x, y, d.cam.near, passed))) continue;
            held |= 1u << k;
            const int at = k * kPadded + place;
            const S weights[4] = {passed.w, passed.px, passed.py, passed.q};
            put_quad(s.weights[at], weights);
            s.rhos[at] = {passed.on_disc, passed.low_pass};
            if (X >= 1) s.depths[at] = passed.z;
          }
          if (!held) continue;
          t.sync_warp();
          if (v.absolute) add_up<true>(t, s, first, held, entry.slot, S(patch.left) + S(0.5), S(patch.top) + S(0.5));
          else add_up<false>(t, s, first, held, entry.slot, S(patch.left) + S(0.5), S(patch.top) + S(0.5));
          t.sync_warp();
          touched |= held << first;
          for (int c = 0; c < C; c += 4) copy_quads<4>(pixel.g + c, s.g[c / 4][place]);  // no registers meanwhile
        }
        if (t.lane() < n) v.activity[entry.slot] = touched >> t.lane() & 1;
      }
    }
#if defined(__CUDACC__)
#pragma unroll 1
#endif
    for (int e = most_of(stop, list.begin) + t.lane(); e < list.end; e += kWarp) v.activity[d.entries[e].slot] = 0;
  }

  // Writes the slots of those of a bucket's surfels whose bits are set in `held`. The bucket is the chunk's from `first`
  // on, a lane has the slot of an entry of the chunk; (x, y): the patch's first pixel centre.
  template <bool absolute, class Thread>
  REFDGS_KERNEL void add_up(Thread& t, Warp& s, int first, uint32_t held, int slot, S x, S y) const {
    constexpr int share = kWarp / kBucket;  // lanes of a surfel
    static_assert(share == kPatchH, "a row a lane");
    const int mine = t.lane() / share, row = t.lane() % share;
    const S* record = s.records[first + mine];
    S r[kDrawnHead];
    copy_quads<4>(r, record);
    if (absolute) copy_quads<4>(r + 4, record + 4);
    const S left = x - r[0], dy = y + S(row) - r[1];
    S px = 0, py = 0, q = 0, low = 0, low_x = 0, rho = 0, gx = 0, gy = 0;
    S G[kWidth] = {};
#if defined(__CUDACC__)
#pragma unroll (absolute ? 1 : 2)
#endif
    for (int k = 0; k < kPatchW; ++k) {
      const int place = row * kRow + k, at = mine * kPadded + place;
      const S dx = left + S(k);
      S p[4];
      copy_quads<4>(p, s.weights[at]);
      const Two rhos = s.rhos[at];
      for (int c = 0; c < C; c += 4) {
        S g[4];
        copy_quads<4>(g, s.g[c / 4][place]);
        for (int j = 0; j < 4; ++j) G[kGradHead + c + j] += p[0] * g[j];
      }
      px += p[1], py += p[2], q += p[3];
      G[2] += p[1] * dx, G[4] += p[2] * dx, G[6] += p[3] * dx;
      low += rhos.low_pass, low_x += rhos.low_pass * dx;
      rho += rhos.on_disc;
      if (X >= 1) G[8] += s.depths[at];
      if (absolute) {
        const S far = S(2 * kLowPass) * rhos.low_pass;
        gx += std::fabs(p[1] * r[2] + p[2] * r[4] + p[3] * r[6] + far * dx);
        gy += std::fabs(p[1] * r[3] + p[2] * r[5] + p[3] * r[7] + far * dy);
      }
    }
    copy_quads<kDrawnHead>(r, record);
    G[0] = -(px * r[2] + py * r[4] + q * r[6] + S(2 * kLowPass) * low_x);
    G[1] = -(px * r[3] + py * r[5] + q * r[7] + S(2 * kLowPass) * low * dy);
    G[3] = px * dy, G[5] = py * dy, G[7] = q * dy;
    G[9] = S(-2) * (rho + low) / r[9];  // where alpha is at its most, both are 0
    G[10] = gx, G[11] = gy;
    t.sync_warp();  // weights have been read
    for (int c = 0; c < kQuads; ++c) put_quad(s.weights[t.lane() * kPitch + c], G + 4 * c);
    t.sync_warp();
    for (int base = 0; base < kBucket * kSlotQuads; base += kWarp) {
      const int k = (base + t.lane()) / kSlotQuads, c = (base + t.lane()) % kSlotQuads;
      const int64_t to = t.shuffle(slot, (first + k) % kWarp);
      if (!(k < kBucket && held >> k & 1)) continue;
      S sum[4] = {};
      if (c < kQuads)
        for (int part = 0; part < share; ++part) {
          S g[4];
          copy_quads<4>(g, s.weights[(k * share + part) * kPitch + c]);
          for (int j = 0; j < 4; ++j) sum[j] += g[j];
        }
      put_quad(v.slots + to * (4 * kSlotQuads) + 4 * c, sum);
    }
  }
};

}  // namespace refdgs::cuda
