// What lies between the other operations, elementwise: one launch each, where plain torch takes several.
#pragma once
#include "../ops/shade.h"
#include "queue.h"

namespace refdgs::cuda {

constexpr int kTerms = 16;       // of one total
constexpr int kMeanEach = 1024;  // numbers of a block, whose sum is one part
constexpr int kTables = 3;       // that a set of surfels carries at most
constexpr int kSets = 3;         // of surfels

// out[0] = the sum of all parts of all terms, added in double and in one fixed order.
template <class S> struct Terms {
  const S* parts[kTerms];
  int64_t count[kTerms];
  int terms;
  S* out;
};
template <class S, class Queue> void total(const Queue& q, const Terms<S>& in);

// Parts of scale times the sum of an image, or of a table's rows [height][width]; slope: [1] the scale.
template <class S> struct ImageMean {
  int64_t width, height;
  Image<S> image;
  const int64_t* pixels;  // [height] rows where this is below 0 do not count; may be null
  S scale;
  S *parts, *slope;
};
template <class S, class Queue> void image_mean(const Queue& q, const ImageMean<S>& in);

enum Curve { kSigmoid, kTanh, kDiffuse };  // kDiffuse: exp(min(x, 5)) / 5
constexpr double kBrightest = 5;

// Tables of a set of surfels, raw and activated; all contiguous. carried: the tables side by side.
template <class S> struct Activation {
  int64_t count;
  const S *log_scales, *raw_opacities, *raw[kTables];  // [count][2], [count], [count][columns[k]]
  int columns[kTables], curve[kTables], tables, channels;
  S *scales, *opacities, *carried;
};
template <class S> struct ActivationGrads {
  const S *v_scales, *v_opacities, *v_carried;
  S *v_log_scales, *v_raw_opacities, *v_raw[kTables];
};
template <class S, class Queue> void activated(const Queue& q, const Activation<S>& in);
template <class S, class Queue> void activated_bwd(const Queue& q, const Activation<S>& in, const ActivationGrads<S>& g);

// Adds scale times the first of two gradients to `sum` and 1 to `seen`, where a surfel's radius is above 0.
template <class S> struct Observed {
  S *sum, *seen;
  const S *gradients, *radii;  // [count][2], [count]
  int64_t count;
};
template <class S> struct Observation {
  Observed<S> set[kSets];
  int sets;
  S scale;
  const float* misfit;  // [1] where this is 1 nothing changes; may be null
};
template <class S, class Queue> void observe(const Queue& q, const Observation<S>& in);

// out [3][count] = grad times min(1, m / max(m + d, kDark) / share), m and d the sums of three colours, mirrored and
// diffuse.
constexpr double kDark = 3e-4;
template <class S> struct Damping {
  int64_t count;
  Rows<const S> grad, mirrored, diffuse;
  S share;
  S* out;
};
template <class S, class Queue> void damped(const Queue& q, const Damping<S>& in);

}  // namespace refdgs::cuda
