// How the bindings of the fused operations read what refdgs_pipe/ops passes, for every device.
#pragma once
#include "arguments.h"
#include "ops/mlp.h"

namespace refdgs {

using Size = const std::vector<int64_t>&;
using Strides = const std::vector<int64_t>&;
using Addresses = const std::vector<Address>&;
using Numbers = const std::vector<double>&;
using Strided = std::pair<Address, std::vector<int64_t>>;
using Images = const std::vector<Strided>&;  // three strides each
using Tables = const std::vector<Strided>&;  // two strides each

// base: level 0; coarser: levels 1 and up, one after the other.
template <class S> MipMap<S> mip_map(Size size, Address base, Address coarser) {
  MipMap<S> map{int(size[0]), int(size[1]), int(size[2]), {at<S>(base)}};
  S* next = at<S>(coarser);
  for (int level = 1; level < map.levels; ++level) {
    map.level[level] = next;
    next += int64_t(map.height >> level) * (map.width >> level) * kMipChannels;
  }
  return map;
}

// in: base, coarser, directions, roughness, coordinates; strides: of directions (2) and of roughness.
template <class S>
SphMipQuery<S> sph_mip_query(Size size, int64_t count, double min_level, Addresses in, Strides strides) {
  const MipMap<S> map = mip_map<S>(size, in[0], in[1]);
  SphMipQuery<S> query{{map.height, map.width, map.levels, {}}, count, at<S>(in[2]), strides[0], strides[1],
                       at<S>(in[3]), strides[2], S(min_level), at<S>(in[4])};
  for (int level = 0; level < map.levels; ++level) query.map.level[level] = map.level[level];
  return query;
}

template <class S> MlpParameters<S> mlp_parameters(Addresses weights, Addresses biases) {
  MlpParameters<S> net{};
  for (size_t l = 0; l < weights.size(); ++l) net.weights[l] = at<S>(weights[l]), net.bias[l] = at<S>(biases[l]);
  return net;
}

// Addresses, each with the strides of rows and columns and the number of columns.
template <class S> MlpTables<S> mlp_tables(Tables columns) {
  MlpTables<S> tables{};
  for (const auto& [address, sizes] : columns)
    tables.of[tables.count++] = {at<S>(address), sizes[0], sizes[1], int(sizes[2])};
  return tables;
}

// shape: points, inputs, hidden layers, outputs, half.

// shape: points, inputs, hidden layers, outputs; cap: empty, or of the exponential.
inline MlpPoints mlp_points(Size shape, Numbers cap, bool half, Address kept) {
  return {shape[0], !cap.empty(), cap.empty() ? 0 : cap[0], half, at<uint32_t>(kept)};
}
inline MlpShape mlp_shape(Size shape) { return {int(shape[1]), int(shape[2]), int(shape[3])}; }

// numbers: fx, fy, cx, cy and the rows of the rotation from the camera to the world.
template <class S> View<S> view_of(Size size, Numbers numbers) {
  View<S> view{int(size[1]), int(size[0]), S(numbers[0]), S(numbers[1]), S(numbers[2]), S(numbers[3]), {}};
  for (int i = 0; i < 9; ++i) view.world_from_cam.m[i] = S(numbers[size_t(4 + i)]);
  return view;
}

template <class S> Rows<S> rows(const Strided& of) { return {at<S>(of.first), of.second[0], of.second[1]}; }
template <class S> Inputs<S> inputs(Tables of) {
  return {rows<S>(of[0]), rows<S>(of[1]), rows<S>(of[2]), rows<S>(of[3]), rows<S>(of[4])};
}

// images: features, alpha, normal, near (address 0: none).
template <class S>
Covered<S> covered(Size size, Numbers numbers, int64_t count, Address pixels, int channels, Images images) {
  return {view_of<S>(size, numbers), count, at<const int64_t>(pixels), channels, image<S>(images[0]),
          image<S>(images[1]), image<S>(images[2]), image<S>(images[3])};
}

// images: normal, features, depth, alpha, the object's alpha; numbers: shaded, scales right and down.
template <class S> Smoothness<S> smoothness_of(Size size, Images images, Numbers numbers, Address v_normal) {
  return {int(size[1]), int(size[0]), image<S>(images[0]), image<S>(images[1]), image<S>(images[2]),
          image<S>(images[3]), image<S>(images[4]), S(numbers[0]), S(numbers[1]), S(numbers[2]), at<S>(v_normal)};
}

// tables: diffuse, radiance; images: object alpha, alpha, behind (address 0: none). The backdrop is black.
template <class S> Composite<S> composite_of(Size size, int64_t count, Address pixels, Tables tables, Images images) {
  return {int(size[1]), int(size[0]), count, at<const int64_t>(pixels), rows<const S>(tables[0]),
          rows<const S>(tables[1]), image<S>(images[0]), image<S>(images[1]), image<S>(images[2]), {}};
}

}  // namespace refdgs
