// From surfels to every patch's list of them: project and count, scan, emit, sort every list.
//
// Bytes and their floor at 4.3 TB/s, for N = 130,000 surfels with 12 channels and E = 1,000,000 entries:
//   Project      reads 40 + 4 C, writes 4 (12 + C, to whole sectors) + 48 + 20 a surfel, 8 an entry: 41 MB, 10 us
//   scan         8 a surfel and a patch, in and out: 2 MB, 1 us; it is CUB's
//   EmitEntries  reads 64 a surfel, writes 12 an entry and counts 8: 28 MB, 7 us
//   SortLists    12 in, 8 out an entry: 20 MB, 5 us
// Arithmetic: some 400 flop a surfel, and 40 instructions for each of 16 patches in a surfel's box, twice: 2 x 5 M
// instructions of warps, 2 x 7 us at 3 a cycle and SM; sorting a list of 64 to 128 takes 700 of a warp, at 10,000
// lists 7 M and 9 us.
//
// A surfel's place in a list is where the list's end happens to be, so lists are filled in any order. Keys are unique
// (depth, then slot, which grows with the surfel's index), so that sorted they are the same in every run.
#pragma once
#include "../math/hit.h"
#include "grid.h"
#include "raster.h"

namespace refdgs::cuda {

// The patches that a surfel's contour or low-pass circle reaches, row by row: visit(patch, lane, slot, shape) for the
// surfel of a lane. A thread walks its own surfel's box; boxes of more than kAlone patches are walked by the whole
// warp, one after the other. Slots are numbered from `start` on either way. Returns how many patches its own surfel
// reaches. shape_of(lane): that of the surfel of a lane, which has a box.
template <class S, class Thread, class ShapeOf, class Visit>
REFDGS_KERNEL int64_t walk_patches(Thread& t, const Drawing<S>& d, Box box, int64_t start, ShapeOf shape_of,
                                   Visit visit) {
  constexpr int kAlone = 64;
  const bool drawn = box.x1 >= box.x0;
  const int x0 = box.x0 / kPatchW, y0 = box.y0 / kPatchH;
  const int wide = drawn ? box.x1 / kPatchW - x0 + 1 : 0;
  const int patches = drawn ? wide * (box.y1 / kPatchH - y0 + 1) : 0;
  const auto reached = [](const Shape<S>& shape, int x, int y) {
    return reaches(shape, S(x * kPatchW) + S(0.5), S(y * kPatchH) + S(0.5), S(kPatchW - 1), S(kPatchH - 1));
  };
  const auto index = [&](int x, int y) {
    constexpr int across = kTile / kPatchW, down = kTile / kPatchH;
    return (y / down * d.tiles_x + x / across) * kPatches + y % down * across + x % across;
  };
  int64_t found = 0;
  if (patches && patches <= kAlone) {
    const Shape<S> own = shape_of(t.lane());
    for (int k = 0, x = x0, y = y0; k < patches; ++k) {
      if (reached(own, x, y)) visit(index(x, y), t.lane(), start + found++, own);
      if (++x == x0 + wide) x = x0, ++y;
    }
  }
  for (uint32_t large = t.ballot(patches > kAlone); large; large &= large - 1) {
    const int from = lowest_bit(large);
    const int64_t first = t.shuffle(start, from);
    const int n = t.shuffle(patches, from), w = t.shuffle(wide, from);
    const int left = t.shuffle(x0, from), top = t.shuffle(y0, from);
    const Shape<S> shape = shape_of(from);
    int64_t seen = 0;
    for (int base = 0; base < n; base += kWarp) {
      const int k = base + t.lane(), x = left + k % w, y = top + k / w;
      const bool hit = k < n && reached(shape, x, y);
      const uint32_t hits = t.ballot(hit);
      if (hit) visit(index(x, y), from, first + seen + bit_count(hits & ((1u << t.lane()) - 1)), shape);
      seen += bit_count(hits);
    }
    if (t.lane() == from) found = seen;
  }
  return found;
}

// One thread: one surfel. Its record is made in shared memory, where the warp counts the entries of patches by it and
// whence eight lanes together write a record, whole sectors at a time. list_end starts as 0.
template <class S> struct Project {
  static constexpr int kThreads = 128, kPitch = kRecordHead + kMaxChannels + 1;  // odd: every lane has its own bank
  struct Shared {
    S made[kThreads][kPitch];
  };
  Drawing<S> d;
  S* radii;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared& s) const {
    const Surfels<S>& in = d.surfels;
    const int64_t first = int64_t(t.block()) * kThreads + t.warp() * kWarp, i = first + t.lane();
    S (*made)[kPitch] = s.made + t.warp() * kWarp;
    Box box{0, 0, -1, -1};
    if (i < in.count) {
      const S opacity = in.opacities[i];
      const Pinhole<S> cam = seen_through(d.lens, d.cam);
      const auto p = refdgs::project(in.means + 3 * i, in.quats + 4 * i, in.scales + 2 * i, opacity, cam);
      radii[i] = p.radius;
      d.boxes[i] = box = p.box;
      if (box.x1 >= box.x0)
        write_record(p, cam, opacity, in.features + i * in.channels, in.channels, d.normals, d.padded,
                     made[t.lane()]);
    }
    const uint32_t drawn = t.ballot(box.x1 >= box.x0);
    t.sync_warp();
    const auto shape_of = [&](int lane) {
      const S *r = made[lane], *k = r + kContour;
      return Shape<S>{{k[0], k[1], k[2], k[3], k[4], k[5], k[6]}, r[10], r[0], r[1], r[8], S(0)};
    };
    const int64_t found = walk_patches(t, d, box, 0, shape_of, [&](int patch, int, int64_t, const Shape<S>&) {
      t.add_bits(d.list_end + patch, 1);
    });
    if (i < in.count) d.slot_start[i] = found;

    const int quads = d.stride / 4, last = (kDrawnHead + d.padded) / 4, q = t.lane() % 8;
    for (int row = t.lane() / 8; row < kWarp; row += kWarp / 8) {
      if (!(drawn >> row & 1) || q >= quads) continue;
      const S* from = made[row] + (4 * q < kDrawnHead ? 4 * q : kRecordHead + 4 * q - kDrawnHead);
      S v[4] = {};
      if (q < last)
        for (int k = 0; k < 4; ++k) v[k] = from[k];
      put_quad(d.records + (first + row) * d.stride + 4 * q, v);
    }
    const int part = t.lane() % 4;
    for (int row = t.lane() / 4; row < kWarp; row += kWarp / 4) {
      if (!(drawn >> row & 1) || part == 3) continue;
      const S *r = made[row], *k = r + kContour + 4 * part;
      S v[4] = {r[0], r[1], r[8], S(0)};
      if (part < 2) v[0] = k[0], v[1] = k[1], v[2] = k[2], v[3] = part ? r[10] : k[3];
      put_quad(d.shapes + (first + row) * kShape + 4 * part, v);
    }
  }
};

// One thread: one surfel. keys: [entries] by place in the lists: depth, then slot; owners: [entries] the surfel of a
// slot. list_end, which says where a list starts, moves to where it ends.
template <class S> struct EmitEntries {
  static constexpr int kThreads = 128;
  using Shared = Nothing;
  Drawing<S> d;
  uint64_t* keys;
  int32_t* owners;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared&) const {
    const int64_t i = int64_t(t.block()) * kThreads + t.thread(), first = i - t.lane();
    const int64_t all = d.slot_start[d.surfels.count];
    if (i == 0 && d.needed) {
      *d.needed = all;
      if (all > d.count) *d.misfit = 1;
    }
    if (all > d.count) return;
    const bool there = i < d.surfels.count;
    const auto shape_of = [&](int lane) {
      S v[kShape];
      copy_quads<kShape>(v, d.shapes + (first + lane) * kShape);
      return Shape<S>{{v[0], v[1], v[2], v[3], v[4], v[5], v[6]}, v[7], v[8], v[9], v[10], v[11]};
    };
    walk_patches(t, d, there ? d.boxes[i] : Box{0, 0, -1, -1}, there ? d.slot_start[i] : 0, shape_of,
                 [&](int patch, int lane, int64_t slot, const Shape<S>& shape) {
                   const float z = float(shape.z);
                   uint32_t depth;
                   memcpy(&depth, &z, 4);
                   keys[t.fetch_add(d.list_end + patch, 1) - all] = uint64_t(depth) << 32 | uint64_t(slot);
                   owners[slot] = int32_t(first) + lane;
                 });
  }
};

// One warp: one patch's list, of up to 256 keys in registers, K a lane. Longer lists are sorted by the block together,
// in shared memory or, above 2048, where they lie. All are Batcher's bitonic sorts whose every exchange puts the less
// first, so that there is nothing to do for what lies behind the list.
template <class S> struct SortLists {
  static constexpr int kThreads = 256, kWarps = kThreads / kWarp, kMostEach = 8;
  struct Shared {
    uint64_t keys[kWarps][kMostEach * kWarp];
  };
  Drawing<S> d;
  uint64_t* keys;
  const int32_t* owners;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared& s) const {
    const int first = t.block() * kWarps;
    const auto own = d.list(first + t.warp());
    const int n = own.end - own.begin;
    if (n > 0 && n <= kMostEach * kWarp) {
      uint64_t* sorted = s.keys[t.warp()];
      if (n <= kWarp) sort_lanes<1>(t, own.begin, n, sorted);
      else if (n <= 2 * kWarp) sort_lanes<2>(t, own.begin, n, sorted);
      else if (n <= 4 * kWarp) sort_lanes<4>(t, own.begin, n, sorted);
      else sort_lanes<8>(t, own.begin, n, sorted);
      t.sync_warp();
      for (int k = t.lane(); k < n; k += kWarp) put(own.begin + k, sorted[k]);
    }
    for (int w = 0; w < kWarps; ++w) {
      const auto list = d.list(first + w);
      const int length = list.end - list.begin;
      if (length <= kMostEach * kWarp) continue;
      uint64_t *there = keys + list.begin, *sorted = there;
      t.sync();  // warps have put what they sorted
      if (length <= kWarps * kMostEach * kWarp) {
        sorted = s.keys[0];
        for (int k = t.thread(); k < length; k += kThreads) sorted[k] = there[k];
      }
      t.sync();
      sort_block(t, sorted, length);
      for (int k = t.thread(); k < length; k += kThreads) put(list.begin + k, sorted[k]);
    }
  }

  REFDGS_KERNEL void put(int at, uint64_t key) const {
    const uint32_t slot = uint32_t(key);
    d.entries[at] = {owners[slot], int32_t(slot)};
  }

  // A lane has K keys in a row.
  template <int K, class Thread> REFDGS_KERNEL void sort_lanes(Thread& t, int begin, int n, uint64_t* sorted) const {
    uint64_t v[K];
    for (int k = 0; k < K; ++k) {
      const int at = k * kWarp + t.lane();
      v[k] = at < n ? keys[begin + at] : ~uint64_t(0);
    }
#if defined(__CUDACC__)
#pragma unroll
#endif
    for (int size = 2; size <= K * kWarp; size *= 2) {
      exchange<K>(t, v, size - 1, size / 2);
#if defined(__CUDACC__)
#pragma unroll
#endif
      for (int stride = size / 4; stride > 0; stride /= 2) exchange<K>(t, v, stride, stride);
    }
    for (int k = 0; k < K; ++k) sorted[t.lane() * K + k] = v[k];
  }

  // Key i meets key i ^ mask, whose numbers differ in bit `high` first.
  template <int K, class Thread> REFDGS_KERNEL void exchange(Thread& t, uint64_t* v, int mask, int high) const {
    uint64_t other[K];
#if defined(__CUDACC__)
#pragma unroll
#endif
    for (int k = 0; k < K; ++k) other[k] = mask < K ? v[k ^ mask] : t.shuffle_xor(v[k ^ (mask % K)], mask / K);
#if defined(__CUDACC__)
#pragma unroll
#endif
    for (int k = 0; k < K; ++k) {
      const bool first = !((t.lane() * K + k) & high);
      if ((other[k] < v[k]) == first) v[k] = other[k];
    }
  }

  template <class Thread> REFDGS_KERNEL void sort_block(Thread& t, uint64_t* v, int n) const {
    const auto meet = [&](int i, int k) {  // i < k
      if (k >= n || v[i] < v[k]) return;
      const uint64_t greater = v[i];
      v[i] = v[k], v[k] = greater;
    };
    for (int64_t size = 2; size < 2 * int64_t(n); size *= 2) {
      const int half = int(size / 2);
      for (int c = t.thread(); c / half * size < n; c += kThreads) {
        const int64_t base = c / half * size;
        const int in = c % half;
        meet(int(base + in), int(base + size - 1 - in < n ? base + size - 1 - in : n));
      }
      t.sync();
      for (int stride = half / 2; stride > 0; stride /= 2) {
        for (int c = t.thread(); c / stride * 2 * stride < n; c += kThreads)
          meet(c / stride * 2 * stride + c % stride, c / stride * 2 * stride + c % stride + stride);
        t.sync();
      }
    }
  }
};

}  // namespace refdgs::cuda
