// A lookup in the Sph-Mip map for one direction: the scalar form of ops/sph_mip.inl, which has the conventions.
#pragma once
#include <cstdint>

#include "vec.h"

namespace refdgs {

constexpr double kMipPi = 3.14159265358979323846;

template <class S> struct MipDirection1 {
  S x, y, z, r2, r;
  REFDGS_HD MipDirection1(S ax, S ay, S az) : x(ax), y(ay), z(az), r2(x * x + y * y), r(std::sqrt(r2 + S(1e-24))) {}
};

template <class S> struct MipPlace {
  S u, v, level;
};
template <class S>
REFDGS_HD MipPlace<S> mip_place(const MipDirection1<S>& d, S roughness, int levels, S min_level) {
  MipPlace<S> p;
  p.u = std::atan2(d.y, d.x) * S(0.5 / kMipPi);
  p.u = p.u < 0 ? p.u + 1 : p.u;
  p.v = std::atan2(d.r, d.z) * S(1 / kMipPi);
  const S level = roughness * S(levels), last = S(levels - 1);
  p.level = level > min_level ? level : min_level;  // so a NaN becomes the bound
  p.level = p.level < last ? p.level : last;
  return p;
}

// The four texels around a place in one level, by their index, and the weights of the second column and row.
template <class S> struct MipCell1 {
  S wx, wy;
  int32_t corner[2][2];
};
template <class S> REFDGS_HD MipCell1<S> mip_cell(S u, S v, int height, int width) {
  MipCell1<S> c;
  const S x = u * S(width) - S(0.5), y = v * S(height) - S(0.5);
  const int column = int(x + 1) - 1;
  int row = int(y + 1) - 1;
  row = row < -1 ? -1 : row > height - 1 ? height - 1 : row;
  c.wx = x - S(column);
  c.wy = y - S(row);
  for (int k = 0; k < 2; ++k) {
    int r = row + k, turn = 0;
    if (r < 0 || r >= height) turn = width / 2;  // past a pole: the same row on the other side
    r = r < 0 ? 0 : r > height - 1 ? height - 1 : r;
    for (int j = 0; j < 2; ++j) c.corner[k][j] = r * width + ((column + j + turn) & (width - 1));
  }
  return c;
}

// Gradients by u, v and level to the direction.
template <class S>
REFDGS_HD Vec3<S> mip_direction_vjp(const MipDirection1<S>& d, S by_u, S by_v, S pole_sine) {
  const S least = pole_sine * pole_sine;
  const S by_azimuth = by_u * S(0.5 / kMipPi) / (d.r2 > least ? d.r2 : least);
  const S by_polar = by_v * S(1 / kMipPi) / (d.r * d.r + d.z * d.z), by_r = by_polar * d.z / d.r;
  return {by_r * d.x - by_azimuth * d.y, by_r * d.y + by_azimuth * d.x, -by_polar * d.r};
}

}  // namespace refdgs
