// The fused per-pixel operations of _refdgs_native; addresses as in bind.cpp.
#include <nanobind/nanobind.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include "fused_arguments.h"
#include "ops/photo.h"

namespace nb = nanobind;
using namespace refdgs;

namespace {

template <class S> void bind_image_loss(nb::module_& m, const char* name) {
  m.def(name, [](Size shape, Address x, Strides x_strides, Address y,
                 Strides y_strides, Address weight, double l1_scale, double ssim_scale,
                 int threads, Address gradient, Address map) {
    nb::gil_scoped_release release;
    LossFrame<S> frame{int(shape[1]), int(shape[0]), int(shape[2]), image<S>(x, x_strides), image<S>(y, y_strides),
                       at<S>(weight), {}, S(l1_scale), S(ssim_scale), at<S>(gradient), at<S>(map)};
    double sums[kLossSums];
    image_loss(frame, threads, sums);
    return std::make_tuple(sums[0], sums[1], sums[2]);
  });
}

template <class S> void bind_sph_mip(nb::module_& m, const char* name, const char* bwd_name) {
  m.def(name, [](Size size, int64_t count, double min_level, const std::vector<Address>& in,
                 Strides strides, int threads, Address out) {
    nb::gil_scoped_release release;
    sph_mip(sph_mip_query<S>(size, count, min_level, in, strides), mip_map<S>(size, in[0], in[1]), threads,
            at<S>(out));
  });
  // grads: base (or 0), coarser, directions, roughness.
  m.def(bwd_name, [](Size size, int64_t count, double min_level,
                     Addresses in, Strides strides, int threads,
                     Address v_out, Addresses grads) {
    nb::gil_scoped_release release;
    sph_mip_bwd(sph_mip_query<S>(size, count, min_level, in, strides), at<const S>(v_out),
                {mip_map<S>(size, grads[0], grads[1]), at<S>(grads[2]), at<S>(grads[3])}, threads);
  });
}

template <class S> void bind_mlp(nb::module_& m, const char* name, const char* bwd_name) {
  m.def(name, [](Size shape, Tables x, Addresses weights, Addresses biases, Numbers cap, Address kept, int threads,
                 Address out) {
    nb::gil_scoped_release release;
    mlp(mlp_shape(shape), mlp_points(shape, cap, shape[4] != 0, kept), mlp_tables<const S>(x),
        mlp_parameters<const S>(weights, biases), threads, at<S>(out));
  });
  m.def(bwd_name, [](Size shape, Tables x, Addresses weights, Addresses biases, Numbers cap, Address kept, int threads,
                     Address out, Address v_out, Tables v_x, Addresses v_weights, Addresses v_biases) {
    nb::gil_scoped_release release;
    mlp_bwd(mlp_shape(shape), mlp_points(shape, cap, shape[4] != 0, kept), mlp_tables<const S>(x),
            mlp_parameters<const S>(weights, biases), threads, at<S>(out), at<const S>(v_out), mlp_tables<S>(v_x),
            mlp_parameters<S>(v_weights, v_biases));
  });
}

template <class S> Composite<S> over(Composite<S> in, Numbers backdrop) {
  for (int c = 0; c < 3; ++c) in.backdrop[c] = S(backdrop[size_t(c)]);
  return in;
}

template <class S> void bind_shade(nb::module_& m, const std::string& type) {
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
    composite(over(composite_of<S>(size, count, pixels, tables, images), backdrop), threads, at<S>(out));
  });
  m.def(("composite_bwd_" + type).c_str(), [](Size size, int64_t count, Address pixels, Tables tables, Images images,
                                              Numbers backdrop, int threads, Images v_image, Addresses grads) {
    nb::gil_scoped_release release;
    composite_bwd(over(composite_of<S>(size, count, pixels, tables, images), backdrop), image<S>(v_image[0]), threads,
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

template <class S> void bind_smoothness(nb::module_& m, const std::string& type) {
  m.def(("normal_smoothness_" + type).c_str(),
        [](Size size, Images images, Numbers numbers, int threads, Address v_normal) {
          nb::gil_scoped_release release;
          return normal_smoothness(smoothness_of<S>(size, images, numbers, v_normal), threads);
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
  bind_smoothness<float>(m, "float");
  bind_smoothness<double>(m, "double");
  bind_photo<float>(m, "float");
  bind_photo<double>(m, "double");
  bind_sph_mip<float>(m, "sph_mip_float", "sph_mip_bwd_float");
  bind_sph_mip<double>(m, "sph_mip_double", "sph_mip_bwd_double");
}
