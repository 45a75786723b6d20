// Rasterising on the grid: what lies where in memory, and the steps of drawing and of the way back. Python
// allocates; `sizes` says how much.
#pragma once
#include <cstdint>

#include "../ops/image_loss.h"  // Image
#include "../ops/raster.h"
#include "../ops/rasterize.h"
#include "lens.h"
#include "queue.h"

namespace refdgs::cuda {

constexpr int kPatchW = 8, kPatchH = 4, kPatches = kTilePixels / 32;  // a warp's pixels; a tile has 8 such

// The planes of one image, where its gradient may be strided or absent (data null).
enum Plane { kFeatures, kAlpha, kNormal, kDepth, kMedian, kDistortion, kPlaneKinds };

// One drawing. Memory by surfel: records, boxes, depths, slot_start; by entry: entries, activity, and for the
// way back slots; by tile: tile_start, patch_stop.
template <class S> struct Drawing {
  Surfels<S> surfels;
  Pinhole<S> cam;
  const S* lens;           // what of the camera lies on the device, see lens.h; may be null
  Extra extra;
  bool normals;
  int padded, stride;      // channels of a record; scalars of a record
  int tiles_x, tiles_y;
  S* records;              // [surfels][stride]; unset where nothing is drawn
  Box* boxes;              // [surfels]
  uint32_t* depths;        // [surfels] bits of the centre's depth as float
  int64_t* slot_start;     // [surfels + 1] first the number of tiles of each, then its sums; the last is their sum
  int64_t count;           // entries that there is room for: as many as there are, or planned
  int64_t* needed;         // [1] gets how many there are; null where `count` is that
  float* misfit;           // [1] becomes 1 where they do not fit
  Entry* entries;          // [count] tile by tile, near to far; a surfel's slots are numbered row by row
  int32_t* tile_start;     // [tiles + 1]
  int32_t* patch_stop;     // [tiles][kPatches] entries from here on are hidden
  S* maps;                 // [planes][H][W], as on the CPU
  S* moments;              // [2][H][W]; only with distortion

  REFDGS_HD int64_t slot(int64_t surfel) const { return slot_start[surfel] < count ? slot_start[surfel] : count; }
  REFDGS_HD int tiles() const { return tiles_x * tiles_y; }
  REFDGS_HD int width() const { return kGradHead + padded; }  // of a slot
};

struct RasterSizes {
  int64_t by_surfel, scan, by_entry, sort;  // bytes; scan and sort are scratch
};

// The drawing's memory laid out in two blocks, which may be null to learn their sizes only.
template <class S> Drawing<S> lay_out(const Surfels<S>& surfels, const Pinhole<S>& cam, Extra extra, bool normals,
                                      int64_t count, void* by_surfel, void* by_entry, RasterSizes* sizes);

constexpr int kShares = 4;  // gradients of one map, which are added as they are read

template <class S> struct DrawingGrads {
  Image<S> maps[kPlaneKinds][kShares];  // of the loss by each map
  S* slots;                    // [count][width]
  uint8_t* activity;           // [count] 0: the slot was not written
  S* sums;                     // [surfels][width]
  S* pose_parts;               // [blocks of kVjpThreads surfels][12], null without a pose gradient
  SurfelGrads<S> out;
};
constexpr int kVjpThreads = 128;

template <class S, class Queue> void project(const Queue& q, const Drawing<S>& d, S* radii, void* scratch,
                                             int64_t bytes);
template <class S, class Queue> void bin_and_draw(const Queue& q, const Drawing<S>& d, void* scratch);
template <class S, class Queue> void draw_bwd(const Queue& q, const Drawing<S>& d, const DrawingGrads<S>& g);
template <class Queue> int64_t sort_scratch(const Queue& q, int64_t count);

// The tile kernels of one number of channels, each in a file of its own.
template <class S, class Queue, int C> void draw_tiles(const Queue& q, const Drawing<S>& d);
template <class S, class Queue, int C>
void draw_tiles_bwd(const Queue& q, const Drawing<S>& d, const DrawingGrads<S>& g);

}  // namespace refdgs::cuda
