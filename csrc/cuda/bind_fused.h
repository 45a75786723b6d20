// The fused operations of cuda/ for Python; addresses as in bind.cpp, the first argument is the stream's.
#pragma once
#include <cmath>

#include "../fused_arguments.h"
#include "adam.h"
#include "bind_raster.h"
#include "image_loss.h"
#include "mlp.h"
#include "photo.h"
#include "shade.h"
#include "sph_mip.h"

namespace refdgs::cuda {

namespace nb = nanobind;
template <class S, class Queue> void bind_image_loss(nb::module_& m, const std::string& type) {
  // images: image, target; constants: weight (or 0), each (or 0); shares: of L1,
  // of SSIM, and each where it is 0; outputs: slopes, gradient, map (each or 0), parts,
  // sums, loss and error (both or 0).
  m.def(("image_loss_" + type).c_str(), [](Address stream, Size shape, Images images, Addresses constants,
                                           Numbers shares, Addresses outputs) {
    nb::gil_scoped_release release;
    LossCall<S> call{int(shape[1]), int(shape[0]), int(shape[2]), image<S>(images[0]), image<S>(images[1]),
                     at<S>(constants[0]), at<S>(constants[1]), S(shares[2]), S(shares[0]), S(shares[1]), {},
                     at<S>(outputs[0]), at<S>(outputs[1]), at<S>(outputs[2]), at<S>(outputs[3]), at<S>(outputs[4]),
                     at<S>(outputs[5]), at<S>(outputs[6])};
    image_loss(Queue{at<void>(stream)}, call);
  });
}

template <class S, class Queue> void bind_sph_mip(nb::module_& m, const std::string& type) {
  // limit: of the directions that are looked at, or 0.
  m.def(("sph_mip_" + type).c_str(), [](Address stream, Size size, int64_t count, double min_level, Addresses in,
                                        Strides strides, Address limit, Address out) {
    nb::gil_scoped_release release;
    sph_mip(Queue{at<void>(stream)},
            LimitedQuery<S>{sph_mip_query<S>(size, count, min_level, in, strides), at<const int64_t>(limit)},
            mip_map<S>(size, in[0], in[1]), at<S>(out));
  });
  // grads: base (or 0), directions, roughness; work: bits (0 with base), scale.
  m.def(("sph_mip_bwd_" + type).c_str(), [](Address stream, Size size, int64_t count, double min_level, Addresses in,
                                            Strides strides, Address limit, Address v_out, Addresses grads,
                                            Addresses work) {
    nb::gil_scoped_release release;
    SphMipGrads<S> to{{int(size[0]), int(size[1]), int(size[2]), {at<S>(grads[0])}}, at<S>(grads[1]), at<S>(grads[2])};
    sph_mip_bwd(Queue{at<void>(stream)},
                LimitedQuery<S>{sph_mip_query<S>(size, count, min_level, in, strides), at<const int64_t>(limit)},
                at<const S>(v_out), to, SphMipWork<S>{at<int64_t>(work[0]), at<uint32_t>(work[1])});
  });
}

// shape: points, inputs, hidden layers, outputs, blocks, tensor cores, bfloat16 products; cap: empty, or of the
// exponential; limit: of the points that are looked at, or 0.
template <class S>
MlpCall<S> mlp_call(Size shape, Tables x, Addresses weights, Addresses biases, Numbers cap, Address limit) {
  MlpCall<S> call{};
  call.shape = mlp_shape(shape);
  call.blocks = int(shape[4]), call.tensor_cores = shape[5] != 0;
  call.points = mlp_points(shape, cap, shape[6] != 0, 0);
  call.x = mlp_tables<const S>(x);
  call.limit = at<const int64_t>(limit);
  call.net = mlp_parameters<const S>(weights, biases);
  call.cap = S(call.points.cap), call.largest = std::exp(call.cap);
  return call;
}

template <class S, class Queue> void bind_mlp(nb::module_& m, const std::string& type) {
  m.def(("mlp_" + type).c_str(), [](Address stream, Size shape, Tables x, Addresses weights, Addresses biases,
                                    Numbers cap, Address limit, Address out) {
    nb::gil_scoped_release release;
    MlpCall<S> call = mlp_call<S>(shape, x, weights, biases, cap, limit);
    call.out = at<S>(out);
    mlp(Queue{at<void>(stream)}, call);
  });
  // data: out, v_out, hidden (0 with bfloat16 products), parts; v_x: as x, or none.
  m.def(("mlp_bwd_" + type).c_str(), [](Address stream, Size shape, Tables x, Addresses weights, Addresses biases,
                                        Numbers cap, Address limit, Addresses data, Tables v_x, Addresses v_weights,
                                        Addresses v_biases) {
    nb::gil_scoped_release release;
    MlpCall<S> call = mlp_call<S>(shape, x, weights, biases, cap, limit);
    call.out = at<S>(data[0]), call.v_out = at<const S>(data[1]), call.v_x = mlp_tables<S>(v_x);
    call.hidden = at<S>(data[2]), call.parts = at<S>(data[3]);
    call.v_net = mlp_parameters<S>(v_weights, v_biases);
    mlp_bwd(Queue{at<void>(stream)}, call);
  });
}

template <class S, class Queue> void bind_shade(nb::module_& m, const std::string& type) {
  // Scratch of covered_pixels: bytes of its counts, and of the scan's own.
  m.def(("covered_sizes_" + type).c_str(), [](Address stream, Size size) {
    CoveredCall<S> call{int(size[1]), int(size[0]), {}, S(0), 0, nullptr, nullptr, nullptr, nullptr};
    const int64_t scan = int64_t(Queue{at<void>(stream)}.scan_bytes(call.blocks() + 1));
    return std::vector<int64_t>{(call.blocks() + 1) * int64_t(sizeof(int64_t)), scan};
  });
  // memory: pixels, counts, the scan's scratch; plan: what is needed, and what says that it does not fit.
  m.def(("covered_pixels_" + type).c_str(), [](Address stream, Size size, Images alpha, double least, int64_t room,
                                               Addresses memory, int64_t bytes, Addresses plan) {
    nb::gil_scoped_release release;
    covered_pixels(Queue{at<void>(stream)},
                   CoveredCall<S>{int(size[1]), int(size[0]), image<S>(alpha[0]), S(least), room,
                                  at<int64_t>(memory[0]), at<int64_t>(memory[1]), at<int64_t>(plan[0]),
                                  at<float>(plan[1])},
                   at<void>(memory[2]), bytes);
  });
  m.def(("shading_inputs_" + type).c_str(), [](Address stream, Size size, Numbers numbers, int64_t count,
                                               Address lens, Address pixels, int channels, Images images,
                                               Tables out) {
    nb::gil_scoped_release release;
    shading_inputs(Queue{at<void>(stream)}, covered<S>(size, numbers, count, pixels, channels, images),
                   at<const S>(lens), inputs<S>(out));
  });
  m.def(("shading_inputs_bwd_" + type).c_str(), [](Address stream, Size size, Numbers numbers, int64_t count,
                                                   Address lens, Address pixels, int channels, Images images,
                                                   Tables v, Addresses grads) {
    nb::gil_scoped_release release;
    shading_inputs_bwd(Queue{at<void>(stream)}, covered<S>(size, numbers, count, pixels, channels, images),
                       at<const S>(lens), inputs<const S>(v),
                       MapGrads<S>{at<S>(grads[0]), at<S>(grads[1]), at<S>(grads[2]), at<S>(grads[3])});
  });
  m.def(("composite_" + type).c_str(), [](Address stream, Size size, int64_t count, Address pixels, Tables tables,
                                          Images images, Address backdrop, Address out) {
    nb::gil_scoped_release release;
    composite(Queue{at<void>(stream)}, composite_of<S>(size, count, pixels, tables, images), at<const S>(backdrop),
              at<S>(out));
  });
  // grads: diffuse + radiance, object alpha, alpha.
  m.def(("composite_bwd_" + type).c_str(), [](Address stream, Size size, int64_t count, Address pixels, Tables tables,
                                              Images images, Address backdrop, Images v_image, Addresses grads) {
    nb::gil_scoped_release release;
    composite_bwd(Queue{at<void>(stream)}, composite_of<S>(size, count, pixels, tables, images),
                  at<const S>(backdrop), image<S>(v_image[0]), at<S>(grads[0]), at<S>(grads[1]), at<S>(grads[2]));
  });
  // images: normal, depth, alpha; grads: of these three and working memory, or all 0; sums: parts, sum.
  m.def(("normal_agreement_" + type).c_str(), [](Address stream, Size size, Numbers numbers, Address lens,
                                                 Images images, double scale, double edge, Addresses grads,
                                                 Addresses sums) {
    nb::gil_scoped_release release;
    normal_agreement(Queue{at<void>(stream)},
                     Agreement<S>{view_of<S>(size, numbers), image<S>(images[0]), image<S>(images[1]),
                                  image<S>(images[2]), S(scale), S(edge), at<S>(grads[0]), at<S>(grads[1]),
                                  at<S>(grads[2])},
                     at<const S>(lens), at<S>(grads[3]), at<S>(sums[0]), at<S>(sums[1]));
  });
  // images: normal, features, depth, alpha, object alpha; numbers: shaded, scales right and down; sums: parts, sum.
  m.def(("normal_smoothness_" + type).c_str(), [](Address stream, Size size, Images images, Numbers numbers,
                                                  Address v_normal, Addresses sums) {
    nb::gil_scoped_release release;
    normal_smoothness(Queue{at<void>(stream)}, smoothness_of<S>(size, images, numbers, v_normal), at<S>(sums[0]),
                      at<S>(sums[1]));
  });
}

template <class S, class Queue> void bind_photo(nb::module_& m, const std::string& type) {
  // photo: rgb, mask (or 0).
  m.def(("composited_" + type).c_str(), [](Address stream, Size size, Addresses photo, Address backdrop, Address out) {
    nb::gil_scoped_release release;
    composited(Queue{at<void>(stream)},
               Photo{int(size[1]), int(size[0]), at<const uint8_t>(photo[0]), at<const uint8_t>(photo[1])},
               at<const S>(backdrop), at<S>(out));
  });
  // out: gradient (or 0), parts, loss.
  m.def(("mask_entropy_" + type).c_str(), [](Address stream, Size size, Images alpha, Address mask, double scale,
                                             Addresses out) {
    nb::gil_scoped_release release;
    mask_entropy(Queue{at<void>(stream)},
                 MaskEntropy<S>{int(size[1]), int(size[0]), image<S>(alpha[0]), at<const uint8_t>(mask), S(scale),
                                at<S>(out[0])},
                 at<S>(out[1]), at<S>(out[2]));
  });
}

template <class S, class Queue> void bind_adam(nb::module_& m, const std::string& type) {
  // addresses: of each tensor values, gradient, mean, square, step and rate (or 0: that in rates); constants: both
  // betas, epsilon.
  m.def(("adam_" + type).c_str(), [](Address stream, Addresses addresses, Size counts, Numbers rates,
                                     Numbers constants, Address misfit) {
    nb::gil_scoped_release release;
    if (counts.size() > size_t(kAdamTensors)) throw std::invalid_argument("too many tensors");
    AdamCall<S> call{};
    call.tensors = int(counts.size());
    for (size_t k = 0; k < counts.size(); ++k) {
      const Address* of = &addresses[6 * k];
      call.tensor[k] = {at<S>(of[0]), at<S>(of[1]), at<S>(of[2]), at<S>(of[3]), at<float>(of[4]),
                        at<const S>(of[5]), counts[k], S(rates[k]), 0};
    }
    call.beta1 = constants[0], call.beta2 = constants[1], call.epsilon = S(constants[2]);
    call.misfit = at<const float>(misfit);
    adam(Queue{at<void>(stream)}, call);
  });
}

}  // namespace refdgs::cuda
