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

// A warp's pixels, which have a list of surfels of their own. Patches are numbered tile by tile of 16x16 pixels.
constexpr int kPatchW = 8, kPatchH = 4, kPatches = kTilePixels / 32;
constexpr int kShape = 12;                     // scalars of a Shape
constexpr int kDrawnHead = 12;                 // of a record here: x y j00 j01 j10 j11 s0 s1 z opacity cut 0
constexpr int sectors(int n) { return (n + 7) / 8 * 8; }  // scalars that fill sectors of 32 bytes

// The planes of one image, where its gradient may be strided or absent (data null).
enum Plane { kFeatures, kAlpha, kNormal, kDepth, kMedian, kDistortion, kPlaneKinds };

// One drawing. Memory by surfel: slot_start, list_end, records, shapes, boxes; by entry, which is a surfel in a patch:
// entries, and for the way back slots, activity; by patch: list_end, patch_stop.
template <class S> struct Drawing {
  Surfels<S> surfels;
  Pinhole<S> cam;
  const S* lens;           // what of the camera lies on the device, see lens.h; may be null
  Extra extra;
  bool normals;
  int padded, stride;      // channels of a record; scalars of a record
  int tiles_x, tiles_y;
  S* records;              // [surfels][stride] head and channels; unset where nothing is drawn
  S* shapes;               // [surfels][kShape] the same
  Box* boxes;              // [surfels]
  int64_t* slot_start;     // [surfels + 1] first the number of entries of each, then its sums; the last is their sum
  int64_t* list_end;       // [patches] behind slot_start, so that one scan makes both: sums above that last one
  int64_t count;           // entries that there is room for: as many as there are, or planned
  int64_t* needed;         // [1] gets how many there are; null where `count` is that
  float* misfit;           // [1] becomes 1 where they do not fit
  Entry* entries;          // [count] patch by patch, near to far; a surfel's slots are numbered row by row
  int32_t* patch_stop;     // [patches] entries from here on are hidden
  S* maps;                 // [planes][H][W], as on the CPU
  S* moments;              // [2][H][W]; only with distortion

  REFDGS_HD int patches() const { return tiles_x * tiles_y * kPatches; }
  REFDGS_HD int width() const { return kGradHead + padded; }  // of the gradients of a record
  REFDGS_HD int slot_width() const { return sectors(width()); }
  REFDGS_HD bool fits() const { return slot_start[surfels.count] <= count; }
  struct List {
    int begin, end;
  };
  // A patch's entries; none where they do not fit.
  REFDGS_HD List list(int patch) const {
    if (!fits()) return {0, 0};
    const int64_t all = slot_start[surfels.count];
    return {patch ? int(list_end[patch - 1] - all) : 0, int(list_end[patch] - all)};
  }
};

struct RasterSizes {
  int64_t by_surfel, scan, by_entry, sort;  // bytes; scan and sort are scratch
  int64_t slot;                             // scalars of a slot
};

// The drawing's memory laid out in two blocks, which may be null to learn their sizes only.
template <class S> Drawing<S> lay_out(const Surfels<S>& surfels, const Pinhole<S>& cam, Extra extra, bool normals,
                                      int64_t count, void* by_surfel, void* by_entry, RasterSizes* sizes);

constexpr int kShares = 4;  // gradients of one map, which are added as they are read

template <class S> struct DrawingGrads {
  Image<S> maps[kPlaneKinds][kShares];  // of the loss by each map
  bool absolute;                        // whether sums of absolute values are made; else they are 0
  S* slots;                             // [count][slot_width]
  uint8_t* activity;           // [count] 0: the slot was not written
  S* sums;                     // [surfels][slot_width]
  S* pose_parts;               // [blocks of kVjpThreads surfels][12], null without a pose gradient
  SurfelGrads<S> out;
};
constexpr int kVjpThreads = 128;

template <class S, class Queue> void project(const Queue& q, const Drawing<S>& d, S* radii, void* scratch,
                                             int64_t bytes);
template <class S, class Queue> void bin_and_draw(const Queue& q, const Drawing<S>& d, void* scratch);
template <class S, class Queue> void draw_bwd(const Queue& q, const Drawing<S>& d, const DrawingGrads<S>& g);
int64_t sort_scratch(int64_t count);

// The tile kernels of one number of channels, each in a file of its own.
template <class S, class Queue, int C> void draw_tiles(const Queue& q, const Drawing<S>& d);
template <class S, class Queue, int C>
void draw_tiles_bwd(const Queue& q, const Drawing<S>& d, const DrawingGrads<S>& g);

}  // namespace refdgs::cuda
