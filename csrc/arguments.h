// How the bindings read what refdgs_pipe/ops passes: addresses of contiguous tensors, and lists of numbers.
#pragma once
#include <cstdint>
#include <utility>
#include <vector>

#include "math/surfel.h"
#include "ops/rasterize.h"
#include "ops/shade.h"
#include "ops/sph_mip.h"

namespace refdgs {

using Address = uintptr_t;
template <class S> S* at(Address a) { return reinterpret_cast<S*>(a); }

template <class S> Pinhole<S> pinhole(const std::vector<double>& p, int width, int height) {
  Pinhole<S> cam;
  for (int row = 0; row < 3; ++row)
    for (int col = 0; col < 3; ++col) cam.R.m[3 * row + col] = S(p[size_t(4 * row + col)]);
  cam.t = {S(p[3]), S(p[7]), S(p[11])};
  cam.fx = S(p[12]), cam.fy = S(p[13]), cam.cx = S(p[14]), cam.cy = S(p[15]);
  cam.near = S(p[16]);
  cam.width = width, cam.height = height;
  return cam;
}

template <class S> Surfels<S> surfels(const std::vector<Address>& a, int64_t count, int channels) {
  return {count, at<S>(a[0]), at<S>(a[1]), at<S>(a[2]), at<S>(a[3]), at<S>(a[4]), channels};
}

template <class S> Image<S> image(Address data, const std::vector<int64_t>& strides) {
  return {at<S>(data), strides[0], strides[1], strides[2]};
}
template <class S> Image<S> image(const std::pair<Address, std::vector<int64_t>>& of) {
  return image<S>(of.first, of.second);
}

}  // namespace refdgs
