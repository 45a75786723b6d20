// The fused operations of cuda/ for Python; addresses as in bind.cpp, the first argument is the stream's.
#pragma once
#include <cmath>

#include "bind_raster.h"
#include "image_loss.h"
#include "mlp.h"
#include "shade.h"
#include "sph_mip.h"

namespace refdgs::cuda {

namespace nb = nanobind;
using Size = const std::vector<int64_t>&;
using Strides = const std::vector<int64_t>&;
using Addresses = const std::vector<Address>&;
using Numbers = const std::vector<double>&;
using Images = const std::vector<std::pair<Address, std::vector<int64_t>>>&;

template <class S, class Queue> void bind_image_loss(nb::module_& m, const std::string& type) {
  // images: image, target; constants: weight (or 0), each; outputs: slopes, gradient, map (each or 0), parts,
  // sums, loss (or 0).
  m.def(("image_loss_" + type).c_str(), [](Address stream, Size shape, Images images, Addresses constants,
                                           Numbers shares, Addresses outputs) {
    nb::gil_scoped_release release;
    LossCall<S> call{int(shape[1]), int(shape[0]), int(shape[2]), image<S>(images[0]), image<S>(images[1]),
                     at<S>(constants[0]), at<S>(constants[1]), S(shares[0]), S(shares[1]), {}, at<S>(outputs[0]),
                     at<S>(outputs[1]), at<S>(outputs[2]), at<S>(outputs[3]), at<S>(outputs[4]), at<S>(outputs[5])};
    image_loss(Queue{at<void>(stream)}, call);
  });
}

// base: level 0; coarser: levels 1 and up, one after the other.
template <class S> MipMap<S> grid_mip_map(Size size, Address base, Address coarser) {
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
SphMipQuery<S> grid_mip_query(Size size, int64_t count, double min_level, Addresses in, Strides strides) {
  const MipMap<S> map = grid_mip_map<S>(size, in[0], in[1]);
  SphMipQuery<S> query{{map.height, map.width, map.levels, {}}, count, at<S>(in[2]), strides[0], strides[1],
                       at<S>(in[3]), strides[2], S(min_level), at<S>(in[4])};
  for (int level = 0; level < map.levels; ++level) query.map.level[level] = map.level[level];
  return query;
}

template <class S, class Queue> void bind_sph_mip(nb::module_& m, const std::string& type) {
  m.def(("sph_mip_" + type).c_str(), [](Address stream, Size size, int64_t count, double min_level, Addresses in,
                                        Strides strides, Address out) {
    nb::gil_scoped_release release;
    sph_mip(Queue{at<void>(stream)}, grid_mip_query<S>(size, count, min_level, in, strides),
            grid_mip_map<S>(size, in[0], in[1]), at<S>(out));
  });
  // grads: base (or 0), directions, roughness; work: bits (0 with base), scale.
  m.def(("sph_mip_bwd_" + type).c_str(), [](Address stream, Size size, int64_t count, double min_level, Addresses in,
                                            Strides strides, Address v_out, Addresses grads, Addresses work) {
    nb::gil_scoped_release release;
    SphMipGrads<S> to{{int(size[0]), int(size[1]), int(size[2]), {at<S>(grads[0])}}, at<S>(grads[1]), at<S>(grads[2])};
    sph_mip_bwd(Queue{at<void>(stream)}, grid_mip_query<S>(size, count, min_level, in, strides), at<const S>(v_out),
                to, SphMipWork<S>{at<int64_t>(work[0]), at<uint32_t>(work[1])});
  });
}

// shape: points, inputs, hidden layers, outputs, blocks; cap: empty, or of the exponential.
template <class S>
MlpCall<S> mlp_call(Size shape, Address x, Strides strides, Addresses weights, Addresses biases, Numbers cap) {
  MlpCall<S> call{};
  call.shape = {int(shape[1]), int(shape[2]), int(shape[3])};
  call.blocks = int(shape[4]);
  call.points = {shape[0], !cap.empty(), cap.empty() ? 0 : cap[0], false, nullptr};
  call.x = at<const S>(x), call.x_row = strides[0], call.x_column = strides[1];
  call.cap = S(call.points.cap), call.largest = std::exp(call.cap);
  for (size_t l = 0; l < weights.size(); ++l)
    call.net.weights[l] = at<const S>(weights[l]), call.net.bias[l] = at<const S>(biases[l]);
  return call;
}

template <class S, class Queue> void bind_mlp(nb::module_& m, const std::string& type) {
  m.def(("mlp_" + type).c_str(), [](Address stream, Size shape, Address x, Strides strides, Addresses weights,
                                    Addresses biases, Numbers cap, Address out) {
    nb::gil_scoped_release release;
    MlpCall<S> call = mlp_call<S>(shape, x, strides, weights, biases, cap);
    call.out = at<S>(out);
    mlp(Queue{at<void>(stream)}, call);
  });
  // data: out, v_out, v_x (or 0), hidden, parts.
  m.def(("mlp_bwd_" + type).c_str(), [](Address stream, Size shape, Address x, Strides strides, Addresses weights,
                                        Addresses biases, Numbers cap, Addresses data, Addresses v_weights,
                                        Addresses v_biases) {
    nb::gil_scoped_release release;
    MlpCall<S> call = mlp_call<S>(shape, x, strides, weights, biases, cap);
    call.out = at<S>(data[0]), call.v_out = at<const S>(data[1]), call.v_x = at<S>(data[2]);
    call.hidden = at<S>(data[3]), call.parts = at<S>(data[4]);
    for (size_t l = 0; l < v_weights.size(); ++l)
      call.v_net.weights[l] = at<S>(v_weights[l]), call.v_net.bias[l] = at<S>(v_biases[l]);
    mlp_bwd(Queue{at<void>(stream)}, call);
  });
}

// numbers: fx, fy, cx, cy and the rows of the rotation from the camera to the world.
template <class S> View<S> grid_view(Size size, Numbers numbers) {
  View<S> view{int(size[1]), int(size[0]), S(numbers[0]), S(numbers[1]), S(numbers[2]), S(numbers[3]), {}};
  for (int i = 0; i < 9; ++i) view.world_from_cam.m[i] = S(numbers[size_t(4 + i)]);
  return view;
}

using Tables = const std::vector<std::pair<Address, std::vector<int64_t>>>&;  // addresses and two strides
template <class S> Rows<S> grid_rows(const std::pair<Address, std::vector<int64_t>>& of) {
  return {at<S>(of.first), of.second[0], of.second[1]};
}
template <class S> Inputs<S> grid_inputs(Tables of) {
  return {grid_rows<S>(of[0]), grid_rows<S>(of[1]), grid_rows<S>(of[2]), grid_rows<S>(of[3]), grid_rows<S>(of[4])};
}

// images: features, alpha, normal, near (address 0: none).
template <class S>
Covered<S> grid_covered(Size size, Numbers numbers, int64_t count, Address pixels, int channels, Images images) {
  return {grid_view<S>(size, numbers), count, at<const int64_t>(pixels), channels, image<S>(images[0]),
          image<S>(images[1]), image<S>(images[2]), image<S>(images[3])};
}

// tables: diffuse, radiance; images: object alpha, alpha, behind (address 0: none).
template <class S>
Composite<S> grid_composite(Size size, int64_t count, Address pixels, Tables tables, Images images) {
  return {int(size[1]), int(size[0]), count, at<const int64_t>(pixels), grid_rows<const S>(tables[0]),
          grid_rows<const S>(tables[1]), image<S>(images[0]), image<S>(images[1]), image<S>(images[2]), {}};
}

template <class S, class Queue> void bind_shade(nb::module_& m, const std::string& type) {
  m.def(("shading_inputs_" + type).c_str(), [](Address stream, Size size, Numbers numbers, int64_t count,
                                               Address pixels, int channels, Images images, Tables out) {
    nb::gil_scoped_release release;
    shading_inputs(Queue{at<void>(stream)}, grid_covered<S>(size, numbers, count, pixels, channels, images),
                   grid_inputs<S>(out));
  });
  m.def(("shading_inputs_bwd_" + type).c_str(), [](Address stream, Size size, Numbers numbers, int64_t count,
                                                   Address pixels, int channels, Images images, Tables v,
                                                   Addresses grads) {
    nb::gil_scoped_release release;
    shading_inputs_bwd(Queue{at<void>(stream)}, grid_covered<S>(size, numbers, count, pixels, channels, images),
                       grid_inputs<const S>(v),
                       MapGrads<S>{at<S>(grads[0]), at<S>(grads[1]), at<S>(grads[2]), at<S>(grads[3])});
  });
  m.def(("composite_" + type).c_str(), [](Address stream, Size size, int64_t count, Address pixels, Tables tables,
                                          Images images, Address backdrop, Address out) {
    nb::gil_scoped_release release;
    composite(Queue{at<void>(stream)}, grid_composite<S>(size, count, pixels, tables, images), at<const S>(backdrop),
              at<S>(out));
  });
  // grads: diffuse + radiance, object alpha, alpha.
  m.def(("composite_bwd_" + type).c_str(), [](Address stream, Size size, int64_t count, Address pixels, Tables tables,
                                              Images images, Address backdrop, Images v_image, Addresses grads) {
    nb::gil_scoped_release release;
    composite_bwd(Queue{at<void>(stream)}, grid_composite<S>(size, count, pixels, tables, images),
                  at<const S>(backdrop), image<S>(v_image[0]), at<S>(grads[0]), at<S>(grads[1]), at<S>(grads[2]));
  });
  // images: normal, depth, alpha; grads: of these three and working memory, or all 0; sums: parts, sum.
  m.def(("normal_agreement_" + type).c_str(), [](Address stream, Size size, Numbers numbers, Images images,
                                                 double scale, double edge, Addresses grads, Addresses sums) {
    nb::gil_scoped_release release;
    normal_agreement(Queue{at<void>(stream)},
                     Agreement<S>{grid_view<S>(size, numbers), image<S>(images[0]), image<S>(images[1]),
                                  image<S>(images[2]), S(scale), S(edge), at<S>(grads[0]), at<S>(grads[1]),
                                  at<S>(grads[2])},
                     at<S>(grads[3]), at<S>(sums[0]), at<S>(sums[1]));
  });
}

}  // namespace refdgs::cuda
