// From surfels to every tile's list of them: project, count, scan, emit, sort, find the tiles' starts.
//
// Bytes and their floor at 4.3 TB/s, for N = 130,000 surfels and E = 600,000 entries:
//   project        reads 40 + 4 C, writes 4 stride (128 at 12 channels) + 20 a surfel: 29 MB, 7 us
//   count, emit    read a record's head (80) twice; write 12 an entry: 28 MB, 7 us
//   sort           (4 passes of 12 bytes in and out, 44 of 64 bits): 60 MB, 14 us; it is CUB's
//   pad            8 an entry that is planned and not needed: 3 MB, 1 us; they are sorted too
//   find_tiles     16 in, 8 out an entry: 14 MB, 3 us
// Arithmetic is some 400 flop a surfel and 60 a tile: below 2 us. So all of it is bound by memory and launches.
#pragma once
#include "../math/hit.h"
#include "grid.h"
#include "raster.h"

namespace refdgs::cuda {

// One thread: one surfel.
template <class S> struct Project {
  static constexpr int kThreads = 128;
  using Shared = Nothing;
  Drawing<S> d;
  S* radii;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared&) const {
    const int64_t i = int64_t(t.block()) * kThreads + t.thread();
    if (i >= d.surfels.count) return;
    const Surfels<S>& in = d.surfels;
    const S opacity = in.opacities[i];
    const Pinhole<S> cam = seen_through(d.lens, d.cam);
    const auto p = refdgs::project(in.means + 3 * i, in.quats + 4 * i, in.scales + 2 * i, opacity, cam);
    radii[i] = p.radius;
    d.boxes[i] = p.box;
    if (p.box.x1 < p.box.x0) return;
    const float z = float(p.splat.z);
    uint32_t bits;
    memcpy(&bits, &z, 4);
    d.depths[i] = bits;
    write_record(p, cam, opacity, in.features + i * in.channels, in.channels, d.normals, d.padded,
                 d.records + i * d.stride);
  }
};

// The tiles that a surfel's contour or low-pass circle reaches, row by row: visit(tile, surfel, slot). A thread
// walks its own surfel's box; boxes of more than kAlone tiles are walked by the whole warp, one after the other.
// Slots are numbered from `start` on either way. Returns how many tiles of its own surfel were reached.
template <class S, class Thread, class Visit>
REFDGS_KERNEL int64_t walk_tiles(Thread& t, const Drawing<S>& d, int64_t i, int64_t start, Visit visit) {
  constexpr int kAlone = 24;
  const Box box = i < d.surfels.count ? d.boxes[i] : Box{0, 0, -1, -1};
  const int x0 = box.x0 / kTile, y0 = box.y0 / kTile;
  const int wide = box.x1 < box.x0 ? 0 : box.x1 / kTile - x0 + 1;
  const int tiles = wide * (box.x1 < box.x0 ? 0 : box.y1 / kTile - y0 + 1);
  const auto reached = [&](int64_t surfel, int x, int y) {
    const S half = S(0.5), side = S(kTile - 1);
    return reaches(d.records + surfel * d.stride, S(x * kTile) + half, S(y * kTile) + half, side, side);
  };
  int64_t found = 0;
  if (tiles <= kAlone)
    for (int k = 0; k < tiles; ++k) {
      const int x = x0 + k % wide, y = y0 + k / wide;
      if (reached(i, x, y)) visit(y * d.tiles_x + x, i, start + found++);
    }
  for (uint32_t large = t.ballot(tiles > kAlone); large; large &= large - 1) {
    const int from = lowest_bit(large);
    const int64_t who = t.shuffle(i, from), first = t.shuffle(start, from);
    const int n = t.shuffle(tiles, from), w = t.shuffle(wide, from);
    const int left = t.shuffle(x0, from), top = t.shuffle(y0, from);
    int64_t seen = 0;
    for (int base = 0; base < n; base += kWarp) {
      const int k = base + t.lane(), x = left + k % w, y = top + k / w;
      const bool hit = k < n && reached(who, x, y);
      const uint32_t hits = t.ballot(hit);
      if (hit) visit(y * d.tiles_x + x, who, first + seen + bit_count(hits & ((1u << t.lane()) - 1)));
      seen += bit_count(hits);
    }
    if (t.lane() == from) found = seen;
  }
  return found;
}

template <class S> struct CountTiles {
  static constexpr int kThreads = 128;
  using Shared = Nothing;
  Drawing<S> d;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared&) const {
    const int64_t i = int64_t(t.block()) * kThreads + t.thread();
    const int64_t tiles = walk_tiles(t, d, i, 0, [](int, int64_t, int64_t) {});
    if (i <= d.surfels.count) d.slot_start[i] = tiles;
  }
};

// Keys: tile, then depth; values: the slot. owners: [entries] the surfel of a slot.
template <class S> struct EmitEntries {
  static constexpr int kThreads = 128;
  using Shared = Nothing;
  Drawing<S> d;
  uint64_t* keys;
  int32_t *slots, *owners;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared&) const {
    const int64_t i = int64_t(t.block()) * kThreads + t.thread();
    const int64_t start = i < d.surfels.count ? d.slot_start[i] : 0;
    walk_tiles(t, d, i, start, [&](int tile, int64_t surfel, int64_t slot) {
      if (slot >= d.count) return;  // there is no room: PadEntries says so
      keys[slot] = uint64_t(uint32_t(tile)) << 32 | d.depths[surfel];
      slots[slot] = int32_t(slot);
      owners[slot] = int32_t(surfel);
    });
  }
};

// What is planned and not needed is sorted behind the last tile.
template <class S> struct PadEntries {
  static constexpr int kThreads = 256;
  using Shared = Nothing;
  Drawing<S> d;
  uint64_t* keys;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared&) const {
    const int64_t e = int64_t(t.block()) * kThreads + t.thread(), needed = d.slot_start[d.surfels.count];
    if (e == 0) {
      *d.needed = needed;
      if (needed > d.count) *d.misfit = 1;
    }
    if (e >= needed && e < d.count) keys[e] = uint64_t(uint32_t(d.tiles())) << 32;
  }
};

// One thread: one sorted entry. It starts every tile after the entry before up to its own.
template <class S> struct FindTiles {
  static constexpr int kThreads = 256;
  using Shared = Nothing;
  Drawing<S> d;
  const uint64_t* keys;
  const int32_t *slots, *owners;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared&) const {
    const int64_t e = int64_t(t.block()) * kThreads + t.thread();
    if (e >= d.count) return;
    const int tile = int(keys[e] >> 32), before = e ? int(keys[e - 1] >> 32) : -1;
    if (tile < d.tiles()) d.entries[e] = {owners[slots[e]], slots[e]};
    for (int k = before + 1; k <= tile; ++k) d.tile_start[k] = int32_t(e);
    if (e + 1 == d.count)
      for (int k = tile + 1; k <= d.tiles(); ++k) d.tile_start[k] = int32_t(d.count);
  }
};

}  // namespace refdgs::cuda
