// Lookups in a lat-long map of 4 channels and its mips: v from the pole +z, u around it, level by roughness.
#pragma once
#include <cstdint>

namespace refdgs {

constexpr int kMipChannels = 4, kMaxMips = 16;
// Nearer to the pole than this sine the azimuth's gradient is damped: it would grow without bound.
constexpr double kPoleSine = 1e-3;

template <class S> struct MipMap {
  int height, width, levels;  // powers of two; level l is height >> l by width >> l
  S* level[kMaxMips];         // [rows][columns][4]
};

template <class S> struct SphMipQuery {
  MipMap<const S> map;
  int64_t count;
  const S* directions;  // element (i, c) at i * direction_row + c * direction_column
  int64_t direction_row, direction_column;
  const S* roughness;   // element i at i * roughness_step
  int64_t roughness_step;
  S min_level;
  S* coordinates;       // [3][count] u, v, level: written forward, read backward
};

template <class S> struct SphMipGrads {
  MipMap<S> map;  // level[0] null if not wanted
  S* directions;  // [count][3]
  S* roughness;   // [count]
};

// Rows of texels that one task scatters into: levels first..last-1 counted as one stack of rows, finest first.
struct MipRows {
  int first_level, last_level;
  int begin, end;
};

template <class S> struct SphMipKernels {
  void (*lookup)(const SphMipQuery<S>&, int64_t begin, int64_t end, S* out);
  void (*lookup_bwd)(const SphMipQuery<S>&, int64_t begin, int64_t end, const S* v_out, const SphMipGrads<S>&);
  void (*scatter)(const SphMipQuery<S>&, const S* v_out, const MipMap<S>& grads, MipRows rows);
};

// Fills the map's coarser levels; out: [count][4].
template <class S> void sph_mip(SphMipQuery<S> query, const MipMap<S>& mips, int threads, S* out);
template <class S>
void sph_mip_bwd(const SphMipQuery<S>& query, const S* v_out, const SphMipGrads<S>& grads, int threads);

}  // namespace refdgs
