// What the tile kernels of every instruction set read and write.
#pragma once
#include <cstdint>

namespace refdgs {

constexpr int kTile = 16;             // pixels along a tile's edge
constexpr int kTilePixels = 256;
constexpr int kMaxChannels = 20;      // constant channels of a surfel: features and normal
constexpr int kRecordHead = 12;       // x y j00 j01 j10 j11 s0 s1 z opacity cut depth-key
constexpr int kGradHead = 12;         // x y j00 j01 j10 j11 s0 s1 z opacity |x| |y|

struct Box {
  int16_t x0, y0, x1, y1;  // pixels, inclusive
};

enum class Extra : int { none = 0, depth = 1, distortion = 2 };  // each includes the one before

// One image being drawn. Planar maps: channels, alpha, then depth, median (Extra::depth), then
// distortion (Extra::distortion).
template <class S> struct RasterFrame {
  int width, height, tiles_x, tiles_y;
  int channels;         // a multiple of 4; the record's tail is padded with zeros
  Extra extra;
  S near;
  int stride;           // scalars in a record
  const S* records;     // [visible][stride]
  const Box* boxes;     // [visible]
  const int32_t* entries;     // visible index of each (tile, surfel) pair, tile by tile, near to far
  const int32_t* slots;       // where each entry's gradient goes
  const int64_t* tile_start;  // [tiles + 1]
  uint64_t* activity;         // [entries] which blocks of the tile the entry touched
  S* moments;                 // [2][H][W] sums of w m and w m^2; only with distortion
};

template <class S> struct RasterKernels {
  void (*forward)(const RasterFrame<S>&, int tile, int32_t* lists, int64_t capacity, S* maps);
  // slots: [entries][kGradHead + channels]
  void (*backward)(const RasterFrame<S>&, int tile, const S* maps, const S* v_maps, S* slots);
};

}  // namespace refdgs
