// One image of one set of surfels: project, sort, bin, draw; and back. Owns its memory and can be reused.
#pragma once
#include <cstdint>
#include <new>
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
  bool absolute = true;             // the second of the screen's gradients
  const uint8_t* needed = nullptr;  // [H][W], 0 where the pixel may stay empty; kept until after backward
};

// Memory that starts with a cache line, so that records do not straddle more lines than they must.
template <class T> struct CacheLines {
  using value_type = T;
  CacheLines() = default;
  template <class U> CacheLines(const CacheLines<U>&) {}
  T* allocate(size_t n) { return static_cast<T*>(::operator new(n * sizeof(T), std::align_val_t(64))); }
  void deallocate(T* p, size_t) { ::operator delete(p, std::align_val_t(64)); }
  template <class U> bool operator==(const CacheLines<U>&) const { return true; }
  template <class U> bool operator!=(const CacheLines<U>&) const { return false; }
};

template <class S> class Raster {
 public:
  // maps: planar, [planes()][H][W]; radii: (N) pixels, 0 where nothing is drawn.
  void forward(const Surfels<S>& surfels, const Pinhole<S>& cam, const RasterOptions& options, S* maps, S* radii);
  // v_maps: where each plane's gradient is, null for zero.
  void backward(const Surfels<S>& surfels, const S* maps, const S* const* v_maps, const SurfelGrads<S>& grads);

  // Planes of the maps: padded channels, alpha, and the extras.
  static int padded(int channels, bool normals) { return (channels + (normals ? 3 : 0) + 3) / 4 * 4; }
  int64_t entries() const { return int64_t(entries_.size()); }

 private:
  void project(const Surfels<S>& surfels, S* radii);
  void sort();
  void bin();
  void reduce(const Surfels<S>& surfels, const SurfelGrads<S>& grads, int64_t i, double* v_pose) const;
  RasterFrame<S> frame();

  Pinhole<S> cam_{};
  RasterOptions options_{};
  int channels_ = 0, stride_ = 0, tiles_x_ = 0, tiles_y_ = 0;
  std::vector<uint64_t> keys_, spare_;  // depth bits << 32 | surfel, near to far once sorted
  // By surfel:
  std::vector<Box> boxes_;              // x1 < x0 where nothing is drawn
  std::vector<uint32_t> depths_;        // bits of the centre's depth
  std::vector<S, CacheLines<S>> records_;
  std::vector<int64_t> slot_start_;     // its slots, one for each tile
  // By slot:
  std::vector<S, CacheLines<S>> slots_;
  std::vector<uint64_t> activity_;
  std::vector<Entry> entries_;          // by tile
  std::vector<int64_t> tile_start_, tile_stop_;
  std::vector<S> moments_;
};

}  // namespace refdgs
