// What the tile kernels of every instruction set read and write.
#pragma once
#include <cstdint>

#include "../math/record.h"

namespace refdgs {

constexpr int kTile = 16;             // pixels along a tile's edge
constexpr int kTilePixels = 256;
constexpr int kMaxChannels = 20;      // constant channels of a surfel: features and normal

struct Entry {
  int32_t surfel, slot;  // slot: where its activity and gradient go
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
  const S* records;     // [surfels][stride]; unset where nothing is drawn
  const Box* boxes;     // [surfels]
  const Entry* entries;       // a surfel in a tile: tile by tile, near to far
  const int64_t* tile_start;  // [tiles + 1]
  int64_t* tile_stop;         // [tiles] entries from here on are hidden
  uint64_t* activity;         // [slots] which blocks of the tile the entry touched
  S* moments;                 // [2][H][W] sums of w m and w m^2; only with distortion
  const uint8_t* needed;      // [H][W], 0: the pixel stays empty and gives no gradient; null: draw all
};

template <class S> struct RasterKernels {
  // Expects activity to be zero.
  void (*forward)(const RasterFrame<S>&, int tile, S* maps);
  // v_maps: where each plane's gradient is, null for zero; slots: [slots][kGradHead + channels]; left alone
  // where there is no activity.
  using Backward = void (*)(const RasterFrame<S>&, int tile, const S* maps, const S* const* v_maps, S* slots);
  Backward backward, backward_absolute;  // without and with the last two of a slot's head, which else are zero
};

}  // namespace refdgs
