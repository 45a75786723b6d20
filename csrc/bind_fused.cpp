// The fused per-pixel operations of _refdgs_native; addresses as in bind.cpp.
#include <nanobind/nanobind.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include "arguments.h"
#include "ops/mlp.h"
#include "ops/photo.h"

namespace nb = nanobind;
using namespace refdgs;

namespace {

template <class S> void bind_image_loss(nb::module_& m, const char* name) {
  m.def(name, [](const std::vector<int64_t>& shape, Address x, const std::vector<int64_t>& x_strides, Address y,
                 const std::vector<int64_t>& y_strides, Address weight, double l1_scale, double ssim_scale,
                 int threads, Address gradient, Address map) {
    nb::gil_scoped_release release;
    LossFrame<S> frame{int(shape[1]), int(shape[0]), int(shape[2]), image<S>(x, x_strides), image<S>(y, y_strides),
                       at<S>(weight), {}, S(l1_scale), S(ssim_scale), at<S>(gradient), at<S>(map)};
    double sums[kLossSums];
    image_loss(frame, threads, sums);
    return std::make_tuple(sums[0], sums[1], sums[2]);
  });
}

// base: level 0; coarser: levels 1 and up, one after the other.
template <class S> MipMap<S> mip_map(const std::vector<int64_t>& size, Address base, Address coarser) {
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
SphMipQuery<S> sph_mip_query(const std::vector<int64_t>& size, int64_t count, double min_level,
                             const std::vector<Address>& in, const std::vector<int64_t>& strides) {
  const MipMap<S> map = mip_map<S>(size, in[0], in[1]);
  SphMipQuery<S> query{{map.height, map.width, map.levels, {}}, count, at<S>(in[2]), strides[0], strides[1],
                       at<S>(in[3]), strides[2], S(min_level), at<S>(in[4])};
  for (int level = 0; level < map.levels; ++level) query.map.level[level] = map.level[level];
  return query;
}

template <class S> void bind_sph_mip(nb::module_& m, const char* name, const char* bwd_name) {
  m.def(name, [](const std::vector<int64_t>& size, int64_t count, double min_level, const std::vector<Address>& in,
                 const std::vector<int64_t>& strides, int threads, Address out) {
    nb::gil_scoped_release release;
    sph_mip(sph_mip_query<S>(size, count, min_level, in, strides), mip_map<S>(size, in[0], in[1]), threads,
            at<S>(out));
  });
  // grads: base (or 0), coarser, directions, roughness.
  m.def(bwd_name, [](const std::vector<int64_t>& size, int64_t count, double min_level,
                     const std::vector<Address>& in, const std::vector<int64_t>& strides, int threads,
                     Address v_out, const std::vector<Address>& grads) {
    nb::gil_scoped_release release;
    sph_mip_bwd(sph_mip_query<S>(size, count, min_level, in, strides), at<const S>(v_out),
                {mip_map<S>(size, grads[0], grads[1]), at<S>(grads[2]), at<S>(grads[3])}, threads);
  });
}

template <class S>
MlpParameters<S> mlp_parameters(const std::vector<Address>& weights, const std::vector<Address>& biases) {
  MlpParameters<S> net{};
  for (size_t l = 0; l < weights.size(); ++l) net.weights[l] = at<S>(weights[l]), net.bias[l] = at<S>(biases[l]);
  return net;
}

// shape: points, inputs, hidden layers, outputs, half; cap: empty, or of the exponential.
MlpPoints mlp_points(const std::vector<int64_t>& shape, const std::vector<double>& cap, Address kept) {
  return {shape[0], !cap.empty(), cap.empty() ? 0 : cap[0], shape[4] != 0, at<uint32_t>(kept)};
}
MlpShape mlp_shape(const std::vector<int64_t>& shape) { return {int(shape[1]), int(shape[2]), int(shape[3])}; }

// Addresses, each with the strides of rows and columns and the number of columns.
using Columns = const std::vector<std::pair<Address, std::vector<int64_t>>>&;
template <class S> MlpTables<S> mlp_tables(Columns columns) {
  MlpTables<S> tables{};
  for (const auto& [address, sizes] : columns)
    tables.of[tables.count++] = {at<S>(address), sizes[0], sizes[1], int(sizes[2])};
  return tables;
}

template <class S> void bind_mlp(nb::module_& m, const char* name, const char* bwd_name) {
  using Addresses = const std::vector<Address>&;
  m.def(name, [](const std::vector<int64_t>& shape, Columns x, Addresses weights, Addresses biases,
                 const std::vector<double>& cap, Address kept, int threads, Address out) {
    nb::gil_scoped_release release;
    mlp(mlp_shape(shape), mlp_points(shape, cap, kept), mlp_tables<const S>(x),
        mlp_parameters<const S>(weights, biases), threads, at<S>(out));
  });
  m.def(bwd_name, [](const std::vector<int64_t>& shape, Columns x, Addresses weights, Addresses biases,
                     const std::vector<double>& cap, Address kept, int threads, Address out, Address v_out,
                     Columns v_x, Addresses v_weights, Addresses v_biases) {
    nb::gil_scoped_release release;
    mlp_bwd(mlp_shape(shape), mlp_points(shape, cap, kept), mlp_tables<const S>(x),
            mlp_parameters<const S>(weights, biases), threads, at<S>(out), at<const S>(v_out), mlp_tables<S>(v_x),
            mlp_parameters<S>(v_weights, v_biases));
  });
}

// numbers: fx, fy, cx, cy and the rows of the rotation from the camera to the world.
template <class S> View<S> view_of(const std::vector<int64_t>& size, const std::vector<double>& numbers) {
  View<S> view{int(size[1]), int(size[0]), S(numbers[0]), S(numbers[1]), S(numbers[2]), S(numbers[3]), {}};
  for (int i = 0; i < 9; ++i) view.world_from_cam.m[i] = S(numbers[size_t(4 + i)]);
  return view;
}

using Images = const std::vector<std::pair<Address, std::vector<int64_t>>>&;
using Tables = const std::vector<std::pair<Address, std::vector<int64_t>>>&;  // addresses and two strides
template <class S> Rows<S> rows(const std::pair<Address, std::vector<int64_t>>& of) {
  return {at<S>(of.first), of.second[0], of.second[1]};
}
template <class S> Inputs<S> inputs(Tables of) {
  return {rows<S>(of[0]), rows<S>(of[1]), rows<S>(of[2]), rows<S>(of[3]), rows<S>(of[4])};
}

// images: features, alpha, normal, near (address 0: none).
template <class S>
Covered<S> covered(const std::vector<int64_t>& size, const std::vector<double>& numbers, int64_t count, Address pixels,
                   int channels, Images images) {
  return {view_of<S>(size, numbers), count, at<const int64_t>(pixels), channels, image<S>(images[0]),
          image<S>(images[1]), image<S>(images[2]), image<S>(images[3])};
}

// tables: diffuse, radiance; images: object alpha, alpha, behind (address 0: none).
template <class S>
Composite<S> composite_of(const std::vector<int64_t>& size, int64_t count, Address pixels, Tables tables, Images images,
                          const std::vector<double>& backdrop) {
  return {int(size[1]), int(size[0]), count, at<const int64_t>(pixels), rows<const S>(tables[0]),
          rows<const S>(tables[1]), image<S>(images[0]), image<S>(images[1]), image<S>(images[2]),
          {S(backdrop[0]), S(backdrop[1]), S(backdrop[2])}};
}

template <class S> void bind_shade(nb::module_& m, const std::string& type) {
  using Addresses = const std::vector<Address>&;
  using Size = const std::vector<int64_t>&;
  using Numbers = const std::vector<double>&;
  m.def(("shading_inputs_" + type).c_str(), [](Size size, Numbers numbers, int64_t count, Address pixels, int channels,
                                               Images images, int threads, Tables out) {
    nb::gil_scoped_release release;
    shading_inputs(covered<S>(size, numbers, count, pixels, channels, images), threads, inputs<S>(out));
  });
  m.def(("shading_inputs_bwd_" + type).c_str(), [](Size size, Numbers numbers, int64_t count, Address pixels,
                                                   int channels, Images images, int threads, Tables v,
                                                   Addresses grads) {
    nb::gil_scoped_release release;
    shading_inputs_bwd(covered<S>(size, numbers, count, pixels, channels, images), inputs<const S>(v), threads,
                       MapGrads<S>{at<S>(grads[0]), at<S>(grads[1]), at<S>(grads[2]), at<S>(grads[3])});
  });
  m.def(("composite_" + type).c_str(), [](Size size, int64_t count, Address pixels, Tables tables, Images images,
                                          Numbers backdrop, int threads, Address out) {
    nb::gil_scoped_release release;
    composite(composite_of<S>(size, count, pixels, tables, images, backdrop), threads, at<S>(out));
  });
  m.def(("composite_bwd_" + type).c_str(), [](Size size, int64_t count, Address pixels, Tables tables, Images images,
                                              Numbers backdrop, int threads, Images v_image, Addresses grads) {
    nb::gil_scoped_release release;
    composite_bwd(composite_of<S>(size, count, pixels, tables, images, backdrop), image<S>(v_image[0]), threads,
                  at<S>(grads[0]), at<S>(grads[1]), at<S>(grads[2]));
  });
  // images: normal, depth, alpha; grads: of these three, or all 0.
  m.def(("normal_agreement_" + type).c_str(), [](Size size, Numbers numbers, Images images, double scale, double edge,
                                                 int threads, Addresses grads) {
    nb::gil_scoped_release release;
    return normal_agreement(Agreement<S>{view_of<S>(size, numbers), image<S>(images[0]), image<S>(images[1]),
                                         image<S>(images[2]), S(scale), S(edge), at<S>(grads[0]), at<S>(grads[1]),
                                         at<S>(grads[2])},
                            threads);
  });
}

template <class S> void bind_photo(nb::module_& m, const std::string& type) {
  using Size = const std::vector<int64_t>&;
  m.def(("composited_" + type).c_str(), [](Size size, Address rgb, Address mask, const std::vector<double>& backdrop,
                                           int threads, Address out) {
    nb::gil_scoped_release release;
    const S color[3] = {S(backdrop[0]), S(backdrop[1]), S(backdrop[2])};
    composited(Photo{int(size[1]), int(size[0]), at<const uint8_t>(rgb), at<const uint8_t>(mask)}, color, threads,
               at<S>(out));
  });
  m.def(("mask_entropy_" + type).c_str(), [](Size size, Images alpha, Address mask, double scale, int threads,
                                             Address v_alpha) {
    nb::gil_scoped_release release;
    return mask_entropy(MaskEntropy<S>{int(size[1]), int(size[0]), image<S>(alpha[0]), at<const uint8_t>(mask),
                                       S(scale), at<S>(v_alpha)},
                        threads);
  });
}

}  // namespace

void bind_fused(nb::module_& m) {
  bind_image_loss<float>(m, "image_loss_float");
  bind_image_loss<double>(m, "image_loss_double");
  m.def("mlp_kept", [](const std::vector<int64_t>& shape) { return mlp_kept(mlp_shape(shape), shape[0], shape[4] != 0); });
  bind_mlp<float>(m, "mlp_float", "mlp_bwd_float");
  bind_mlp<double>(m, "mlp_double", "mlp_bwd_double");
  bind_shade<float>(m, "float");
  bind_shade<double>(m, "double");
  bind_photo<float>(m, "float");
  bind_photo<double>(m, "double");
  bind_sph_mip<float>(m, "sph_mip_float", "sph_mip_bwd_float");
  bind_sph_mip<double>(m, "sph_mip_double", "sph_mip_bwd_double");
}
