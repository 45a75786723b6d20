// The operations of cuda/elementwise.h for Python; addresses as in bind.cpp, the first argument is the stream's.
#pragma once
#include <nanobind/nanobind.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <stdexcept>
#include <string>

#include "../fused_arguments.h"
#include "elementwise.h"

namespace refdgs::cuda {

inline void check_most(size_t given, int most) {
  if (given > size_t(most)) throw std::invalid_argument("too many at once");
}

// in: raw scales, opacities and tables; out: scales, opacities, what is carried; columns and curves of the tables.
template <class S> Activation<S> activation_of(int64_t count, Addresses in, Size columns, Size curves, Addresses out) {
  check_most(columns.size(), kTables);
  Activation<S> a{};
  a.count = count, a.log_scales = at<const S>(in[0]), a.raw_opacities = at<const S>(in[1]);
  a.tables = int(columns.size());
  for (size_t k = 0; k < columns.size(); ++k) {
    a.raw[k] = at<const S>(in[2 + k]), a.columns[k] = int(columns[k]), a.curve[k] = int(curves[k]);
    a.channels += int(columns[k]);
  }
  a.scales = at<S>(out[0]), a.opacities = at<S>(out[1]), a.carried = at<S>(out[2]);
  return a;
}

template <class S, class Queue> void bind_elementwise(nanobind::module_& m, const std::string& type) {
  namespace nb = nanobind;
  m.def(("total_" + type).c_str(), [](Address stream, Addresses parts, Size counts, Address out) {
    nb::gil_scoped_release release;
    check_most(parts.size(), kTerms);
    Terms<S> in{};
    in.terms = int(parts.size()), in.out = at<S>(out);
    for (size_t k = 0; k < parts.size(); ++k) in.parts[k] = at<const S>(parts[k]), in.count[k] = counts[k];
    total(Queue{at<void>(stream)}, in);
  });
  // pixels: of rows, or 0; out: parts, slope.
  m.def(("image_mean_" + type).c_str(), [](Address stream, Size size, Images images, Address pixels, double scale,
                                           Addresses out) {
    nb::gil_scoped_release release;
    image_mean(Queue{at<void>(stream)}, ImageMean<S>{size[1], size[0], image<S>(images[0]), at<const int64_t>(pixels),
                                                     S(scale), at<S>(out[0]), at<S>(out[1])});
  });
  m.def(("activated_" + type).c_str(), [](Address stream, int64_t count, Addresses in, Size columns, Size curves,
                                          Addresses out) {
    nb::gil_scoped_release release;
    activated(Queue{at<void>(stream)}, activation_of<S>(count, in, columns, curves, out));
  });
  // v: of scales, opacities, what is carried; grads: of raw scales, opacities and tables.
  m.def(("activated_bwd_" + type).c_str(), [](Address stream, int64_t count, Addresses in, Size columns, Size curves,
                                              Addresses out, Addresses v, Addresses grads) {
    nb::gil_scoped_release release;
    ActivationGrads<S> g{at<const S>(v[0]), at<const S>(v[1]), at<const S>(v[2]), at<S>(grads[0]), at<S>(grads[1]), {}};
    for (size_t k = 0; k < columns.size(); ++k) g.v_raw[k] = at<S>(grads[2 + k]);
    activated_bwd(Queue{at<void>(stream)}, activation_of<S>(count, in, columns, curves, out), g);
  });
  // addresses: of each set sum, seen, gradients, radii.
  m.def(("observe_" + type).c_str(), [](Address stream, Addresses addresses, Size counts, double scale, Address misfit) {
    nb::gil_scoped_release release;
    check_most(counts.size(), kSets);
    Observation<S> in{};
    in.sets = int(counts.size()), in.scale = S(scale), in.misfit = at<const float>(misfit);
    for (size_t k = 0; k < counts.size(); ++k) {
      const Address* of = &addresses[4 * k];
      in.set[k] = {at<S>(of[0]), at<S>(of[1]), at<const S>(of[2]), at<const S>(of[3]), counts[k]};
    }
    observe(Queue{at<void>(stream)}, in);
  });
  // tables: the gradient, mirrored and diffuse light.
  m.def(("damped_" + type).c_str(), [](Address stream, int64_t count, Tables tables, double share, Address out) {
    nb::gil_scoped_release release;
    damped(Queue{at<void>(stream)}, Damping<S>{count, rows<const S>(tables[0]), rows<const S>(tables[1]),
                                               rows<const S>(tables[2]), S(share), at<S>(out)});
  });
}

}  // namespace refdgs::cuda
