// One image of one set of surfels: project, sort, bin, draw; and back. Owns its memory and can be reused.
#pragma once
#include <cstdint>
#include <vector>

#include "../math/surfel.h"
#include "raster.h"

namespace refdgs {

template <class S> struct Surfels {
  int64_t count;
  const S *means, *quats, *scales, *opacities, *features;  // (N,3) (N,4) (N,2) (N) (N,C)
  int channels;                                            // C
};

template <class S> struct SurfelGrads {
  S *means, *quats, *scales, *opacities, *features;
  S* cam_from_world;  // (3, 4), may be null
  S* screen;          // (N, 2): |g| and sum of |g| per pixel, of the projected centre, in pixels
};

struct RasterOptions {
  Extra extra;
  bool normals;  // append the world-space normal to the channels
  int threads;
};

template <class S> class Raster {
 public:
  // maps: planar, [planes()][H][W]; radii: (N) pixels, 0 where nothing is drawn.
  void forward(const Surfels<S>& surfels, const Pinhole<S>& cam, const RasterOptions& options, S* maps, S* radii);
  void backward(const Surfels<S>& surfels, const S* maps, const S* v_maps, const SurfelGrads<S>& grads);

  // Planes of the maps: padded channels, alpha, and the extras.
  static int padded(int channels, bool normals) { return (channels + (normals ? 3 : 0) + 3) / 4 * 4; }
  int64_t entries() const { return int64_t(entries_.size()); }

 private:
  void project(const Surfels<S>& surfels, S* radii);
  void sort();
  void write_records(const Surfels<S>& surfels);
  void bin();
  RasterFrame<S> frame();

  Pinhole<S> cam_{};
  RasterOptions options_{};
  int channels_ = 0, stride_ = 0, tiles_x_ = 0, tiles_y_ = 0;
  int64_t longest_tile_ = 0;
  std::vector<Splat<S>> splats_;       // by surfel
  std::vector<Box> all_boxes_;         // by surfel; x1 < x0 where nothing is drawn
  std::vector<uint64_t> keys_, spare_;  // depth bits << 32 | surfel, near to far once sorted
  std::vector<S> records_, slots_, moments_;
  std::vector<Box> boxes_;             // by visible index
  std::vector<int32_t> entries_, entry_slots_;
  std::vector<int64_t> slot_start_, tile_start_;
  std::vector<uint64_t> activity_;
  std::vector<std::vector<int32_t>> lists_;  // by thread
};

}  // namespace refdgs
