// The fused per-pixel operations of _refdgs_native; addresses as in bind.cpp.
#include <nanobind/nanobind.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/vector.h>

#include "ops/image_loss.h"

namespace nb = nanobind;
using namespace refdgs;

namespace {

using Address = uintptr_t;
template <class S> S* at(Address a) { return reinterpret_cast<S*>(a); }

template <class S> Image<S> image(Address data, const std::vector<int64_t>& strides) {
  return {at<S>(data), strides[0], strides[1], strides[2]};
}

template <class S> void bind_image_loss(nb::module_& m, const char* name) {
  m.def(name, [](const std::vector<int64_t>& shape, Address x, const std::vector<int64_t>& x_strides, Address y,
                 const std::vector<int64_t>& y_strides, Address weight, double l1_scale, double ssim_scale,
                 int threads, Address gradient, Address map) {
    nb::gil_scoped_release release;
    LossFrame<S> frame{int(shape[1]), int(shape[0]), int(shape[2]), image<S>(x, x_strides), image<S>(y, y_strides),
                       at<S>(weight), {}, S(l1_scale), S(ssim_scale), at<S>(gradient), at<S>(map)};
    double sums[2];
    image_loss(frame, threads, sums);
    return std::make_pair(sums[0], sums[1]);
  });
}

}  // namespace

void bind_fused(nb::module_& m) {
  bind_image_loss<float>(m, "image_loss_float");
  bind_image_loss<double>(m, "image_loss_double");
}
