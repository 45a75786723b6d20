// Sph-Mip: mips by box averages, trilinear lookups, and their gradients.
//
// The map's gradient is added up in whole numbers of 64 bits: sums of integers do not depend on their order, so the
// atomics of thousands of directions that meet in one texel give the same bits in every run. One unit is the greatest
// |v_out| times 2^-42 or less (the count of directions decides), far below a float's rounding.
//
// At 320,000 directions and a 512 x 1024 map: mips read 8.4 MB and write 2.8 MB, 3 us at 4.3 TB/s. A lookup reads 8
// texels of 16 bytes, 128 bytes of which the caches hold most, 16 bytes of direction and roughness, and writes 16 + 12:
// 14 MB, 4 us; 150 flop: 1 us. Backward reads the same and adds 32 numbers of 8 bytes in the second-level cache: 10 M
// atomics. Where directions meet in few texels of a coarse level they wait for each other (0.9 ms on an H200), so lanes
// of one cell add their numbers first: 0.6 M atomics and some 13 M instructions, 30 us. Clearing and reading the sums:
// 44 MB, 10 us.
#pragma once
#include "../math/sph_mip.h"
#include "grid.h"
#include "sph_mip.h"

namespace refdgs::cuda {

// A block averages a square patch of level `first` down to the level where the patch is one texel.
template <class S> struct AverageLevels {
  static constexpr int kThreads = 256, kSide = 32;
  struct Shared {
    S texels[kSide / 2][kSide / 2][kMipChannels];
  };
  MipMap<S> map;
  int first, last;  // levels first + 1 .. last are made

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared& s) const {
    const int width = map.width >> first, height = map.height >> first;
    const int across = (width + kSide - 1) / kSide;
    const int left = t.block() % across * kSide, top = t.block() / across * kSide;
    int side = kSide / 2;
    for (int level = first + 1; level <= last; ++level, side /= 2) {
      const int shift = level - first, w = width >> shift, h = height >> shift;
      // one texel and channel group a thread; the patch of this level has side x side texels
      const int x = t.thread() % side, y = t.thread() / side;
      const bool mine = t.thread() < side * side && (left >> shift) + x < w && (top >> shift) + y < h;
      S sum[kMipChannels];
      if (mine) {
        for (int c = 0; c < kMipChannels; ++c) {
          S v[2][2];
          for (int k = 0; k < 2; ++k)
            for (int j = 0; j < 2; ++j)
              v[k][j] = level == first + 1
                            ? map.level[first][(int64_t(top + 2 * y + k) * width + left + 2 * x + j) * kMipChannels + c]
                            : s.texels[2 * y + k][2 * x + j][c];
          sum[c] = S(0.25) * ((v[0][0] + v[0][1]) + (v[1][0] + v[1][1]));
        }
      }
      t.sync();
      if (mine) {
        const int64_t texel = int64_t((top >> shift) + y) * w + (left >> shift) + x;
        for (int c = 0; c < kMipChannels; ++c) {
          s.texels[y][x][c] = sum[c];
          map.level[level][texel * kMipChannels + c] = sum[c];
        }
      }
      t.sync();
    }
  }
};

template <class S> REFDGS_KERNEL MipDirection1<S> direction_of(const SphMipQuery<S>& q, int64_t i) {
  const S* d = q.directions + i * q.direction_row;
  return {d[0], d[q.direction_column], d[2 * q.direction_column]};
}

// A place between two levels.
template <class S> struct MipPair {
  int level[2];
  S blend;  // the coarser level's share
  MipCell1<S> cell[2];

  REFDGS_KERNEL MipPair(const MipPlace<S>& p, int height, int width, int levels) {
    level[0] = int(p.level);
    level[1] = level[0] + 1 > levels - 1 ? levels - 1 : level[0] + 1;
    blend = p.level - S(level[0]);
    for (int k = 0; k < 2; ++k) cell[k] = mip_cell(p.u, p.v, height >> level[k], width >> level[k]);
  }
};

// The texels of one cell.
template <class S> struct MipTexels {
  S t[2][2][kMipChannels], wx, wy;
  REFDGS_KERNEL MipTexels(const S* level, const MipCell1<S>& c) : wx(c.wx), wy(c.wy) {
    for (int k = 0; k < 2; ++k)
      for (int j = 0; j < 2; ++j) copy_quads<kMipChannels>(t[k][j], level + int64_t(c.corner[k][j]) * kMipChannels);
  }
  REFDGS_KERNEL S row(int k, int c) const { return t[k][0][c] + wx * (t[k][1][c] - t[k][0][c]); }
  REFDGS_KERNEL S value(int c) const { return row(0, c) + wy * (row(1, c) - row(0, c)); }
  REFDGS_KERNEL S by_x(int c) const {
    const S top = t[0][1][c] - t[0][0][c], bottom = t[1][1][c] - t[1][0][c];
    return top + wy * (bottom - top);
  }
  REFDGS_KERNEL S by_y(int c) const { return row(1, c) - row(0, c); }
};

template <class S> struct LookUp {
  static constexpr int kThreads = 256;
  using Shared = Nothing;
  LimitedQuery<S> q;
  S* out;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared&) const {
    const int64_t i = int64_t(t.block()) * kThreads + t.thread();
    if (i >= q.last()) return;
    const MipPlace<S> p = mip_place(direction_of(q, i), q.roughness[i * q.roughness_step], q.map.levels, q.min_level);
    q.coordinates[i] = p.u, q.coordinates[q.count + i] = p.v, q.coordinates[2 * q.count + i] = p.level;
    const MipPair<S> pair(p, q.map.height, q.map.width, q.map.levels);
    const MipTexels<S> fine(q.map.level[pair.level[0]], pair.cell[0]);
    const MipTexels<S> coarse(q.map.level[pair.level[1]], pair.cell[1]);
    for (int c = 0; c < kMipChannels; ++c) {
      const S value = fine.value(c);
      out[i * kMipChannels + c] = value + pair.blend * (coarse.value(c) - value);
    }
  }
};

// The greatest |v_out|: the bits of floats that are not negative are in the order of their values; a NaN is greatest.
template <class S> struct FindScale {
  static constexpr int kThreads = 256, kEach = 8;
  using Shared = Nothing;
  const S* v_out;
  LimitedQuery<S> q;
  uint32_t* scale;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared&) const {
    const int64_t numbers = q.last() * kMipChannels;
    uint32_t greatest = 0;
    for (int k = 0; k < kEach; ++k) {
      const int64_t i = (int64_t(t.block()) * kEach + k) * kThreads + t.thread();
      const float v = i < numbers ? std::fabs(float(v_out[i])) : 0.0f;
      uint32_t bits;
      memcpy(&bits, &v, 4);
      greatest = bits > greatest ? bits : greatest;
    }
    for (int half = kWarp / 2; half > 0; half /= 2) {
      const uint32_t other = t.shuffle_xor(greatest, half);
      greatest = other > greatest ? other : greatest;
    }
    if (t.lane() == 0 && greatest) t.raise_bits(scale, greatest);
  }
};

// The power of two by which a share of v_out becomes a whole number: sums of `count` shares stay below 2^62. The
// result is NaN if a gradient is not finite, and so is all that is made with it.
template <class S> REFDGS_KERNEL S unit_of(const uint32_t* scale, int64_t count) {
  const uint32_t bits = *scale;
  if (bits >= 0x7f800000u) return S(NAN);
  int count_bits = 0;
  while (count >> count_bits) ++count_bits;
  const int exponent = int(bits >> 23) - 126, power = 61 - count_bits - exponent;  // |v_out| < 2^exponent
  return std::ldexp(S(1), power < 120 ? power : 120);
}

template <class S> struct LookUpBwd {
  static constexpr int kThreads = 256;
  static constexpr int kTogether = 4;  // lanes that are worth a sum of their own
  static constexpr int kRounds = 8;    // of such sums at most
  using Shared = Nothing;
  LimitedQuery<S> q;
  const S* v_out;
  SphMipGrads<S> grads;
  SphMipWork<S> work;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared&) const {
    const int64_t first = int64_t(t.block()) * kThreads + t.thread(), last = q.last();
    if (first - t.lane() >= last) return;  // a whole warp
    const bool there = first < last;
    const int64_t i = there ? first : last - 1;
    const MipPlace<S> p{q.coordinates[i], q.coordinates[q.count + i], q.coordinates[2 * q.count + i]};
    const MipPair<S> pair(p, q.map.height, q.map.width, q.map.levels);
    S g[kMipChannels];
    copy_quads<kMipChannels>(g, v_out + i * kMipChannels);
    S by_u = 0, by_v = 0, by_level = 0;
    for (int k = 0; k < 2; ++k) {
      const MipTexels<S> texels(q.map.level[pair.level[k]], pair.cell[k]);
      const S share = k ? pair.blend : 1 - pair.blend;
      const S width = S(q.map.width >> pair.level[k]), height = S(q.map.height >> pair.level[k]);
      for (int c = 0; c < kMipChannels; ++c) {
        by_u += g[c] * share * width * texels.by_x(c);
        by_v += g[c] * share * height * texels.by_y(c);
        by_level += k ? g[c] * texels.value(c) : -(g[c] * texels.value(c));
      }
    }
    if (there) {
      const Vec3<S> d = mip_direction_vjp(direction_of(q, i), by_u, by_v, S(kPoleSine));
      grads.directions[3 * i] = d.x, grads.directions[3 * i + 1] = d.y, grads.directions[3 * i + 2] = d.z;
      const S level = q.roughness[i * q.roughness_step] * S(q.map.levels);
      const bool free = level >= q.min_level && level <= S(q.map.levels - 1);
      grads.roughness[i] = free ? by_level * S(q.map.levels) : S(0);
    }
    if (!work.bits) return;
    const bool adds = there && (g[0] != 0 || g[1] != 0 || g[2] != 0 || g[3] != 0);  // a NaN is not 0
    const S unit = unit_of<S>(work.scale, last);
    for (int c = 0; c < kMipChannels; ++c) g[c] *= unit;
    scatter(t, adds && pair.blend != 1, pair.level[0], pair.cell[0], 1 - pair.blend, g);
    scatter(t, adds && pair.blend != 0, pair.level[1], pair.cell[1], pair.blend, g);
  }

  // Lanes whose directions meet in one cell add their shares first, and one lane a number adds the sum: neighbours in
  // an image look at the same few texels of a coarse level. Sums of whole numbers are the same either way.
  template <class Thread>
  REFDGS_KERNEL void scatter(Thread& t, bool adds, int level, const MipCell1<S>& c, S share, const S* g) const {
    const int64_t above = texels_above(level);
    // two opposite corners tell the other two
    const int64_t key = int64_t(level) << 48 | int64_t(c.corner[0][0]) << 24 | c.corner[1][1];
    const int lane = t.lane();
    uint32_t left = t.ballot(adds), alone = 0;
    for (int round = 0; left && round < kRounds; ++round) {
      const int leader = lowest_bit(left);
      const int64_t theirs = t.shuffle(key, leader);
      const bool mine = (left >> lane & 1) && key == theirs;
      const uint32_t group = t.ballot(mine);
      left &= ~group;
      if (bit_count(group) < kTogether) {
        alone |= group;
        continue;
      }
      int64_t numbers[4 * kMipChannels];
      for (int k = 0; k < 4; ++k)
        for (int channel = 0; channel < kMipChannels; ++channel)
          numbers[k * kMipChannels + channel] = mine ? number(c, k, share, g[channel]) : 0;
      const int64_t total = sum_lanes<4 * kMipChannels>(t, numbers);
      int64_t texel = t.shuffle(above, leader);
      for (int k = 0; k < 4; ++k) {
        const int32_t corner = t.shuffle(c.corner[k / 2][k % 2], leader);
        if (lane / kMipChannels == k) texel += corner;
      }
      if (lane < 4 * kMipChannels && total) t.add_bits(work.bits + texel * kMipChannels + lane % kMipChannels, total);
    }
    if (!((left | alone) >> lane & 1)) return;
    for (int k = 0; k < 4; ++k)
      for (int channel = 0; channel < kMipChannels; ++channel)
        t.add_bits(work.bits + (above + c.corner[k / 2][k % 2]) * kMipChannels + channel,
                   number(c, k, share, g[channel]));
  }

  // A corner's share of a gradient in units.
  static REFDGS_KERNEL int64_t number(const MipCell1<S>& c, int k, S share, S g) {
    const S weight = share * (k / 2 ? c.wy : 1 - c.wy) * (k % 2 ? c.wx : 1 - c.wx);
    return int64_t(std::llrint(weight * g));
  }

  // Texels of the levels finer than this one.
  REFDGS_KERNEL int64_t texels_above(int level) const {
    int64_t texels = 0;
    for (int l = 0; l < level; ++l) texels += int64_t(q.map.height >> l) * (q.map.width >> l);
    return texels;
  }
};

// One number of level 0: its own sum and its share of every coarser level's, 4^-level.
template <class S> struct GatherLevels {
  static constexpr int kThreads = 256;
  using Shared = Nothing;
  LimitedQuery<S> q;
  SphMipWork<S> work;
  S* out;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared&) const {
    const int64_t i = int64_t(t.block()) * kThreads + t.thread();
    const int width = q.map.width;
    if (i >= int64_t(q.map.height) * width * kMipChannels) return;
    const int channel = int(i % kMipChannels);
    const int64_t texel = i / kMipChannels, row = texel / width, column = texel % width;
    const int64_t* bits = work.bits;
    double sum = 0, share = 1 / double(unit_of<S>(work.scale, q.last()));
    for (int l = 0; l < q.map.levels; ++l, share *= 0.25) {
      const int64_t w = width >> l;
      sum += share * double(bits[((row >> l) * w + (column >> l)) * kMipChannels + channel]);
      bits += (q.map.height >> l) * w * kMipChannels;
    }
    out[i] = S(sum);
  }
};

}  // namespace refdgs::cuda
