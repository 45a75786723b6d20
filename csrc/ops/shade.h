// The deferred shading around the shader's network, per covered pixel: what it is given, how its result becomes
// a picture, and how far splatted normals are from those of the depth map. Elementwise, bound by memory.
#pragma once
#include <cstdint>

#include "../math/vec.h"
#include "image_loss.h"  // Image

namespace refdgs {

template <class S> struct View {
  int width, height;
  S fx, fy, cx, cy;
  Mat3<S> world_from_cam;
};

// Features, normal and near are premultiplied by alpha, as splatted; near.data may be null.
template <class S> struct Covered {
  View<S> view;
  int64_t count;
  const int64_t* pixels;  // row * width + column
  Image<S> features, alpha, normal, near;
};

// Per covered pixel: features / alpha [4], unit mirrored ray [3], cosine in 0..1, near as it is [4].
template <class S> struct Inputs {
  S *carried, *reflected, *cosine, *near;
};

template <class S> void shading_inputs(const Covered<S>& at, int threads, const Inputs<S>& out);

// Gradients by plane [C][H][W]; only covered pixels are written.
template <class S> struct MapGrads {
  S *features, *alpha, *normal, *near;
};
template <class S>
void shading_inputs_bwd(const Covered<S>& at, const Inputs<const S>& v_out, int threads, const MapGrads<S>& grads);

// image = object_alpha srgb(diffuse + radiance) + (1 - alpha) backdrop + behind, planes [3][H][W].
template <class S> struct Composite {
  int width, height;
  int64_t count;
  const int64_t* pixels;
  const S* diffuse;  // element (i, c) at i * diffuse_row + c
  int64_t diffuse_row;
  const S* radiance;  // [count][3]
  Image<S> object_alpha, alpha, behind;  // behind.data may be null
  S backdrop[3];
};

template <class S> void composite(const Composite<S>& in, int threads, S* image);
template <class S>
void composite_bwd(const Composite<S>& in, Image<S> v_image, int threads, S* v_linear, S* v_object_alpha, S* v_alpha);

// Sum over pixels with four neighbours of alpha (1 - n . n_depth); gradients of scale times it, by plane; scratch:
// [6][H][W].
template <class S> struct Agreement {
  View<S> view;
  Image<S> normal, depth, alpha;  // sums of w n, of w z, of w
  S scale;
  S *v_normal, *v_depth, *v_alpha, *scratch;  // all null if not wanted
};
template <class S> double normal_agreement(const Agreement<S>& in, int threads);

}  // namespace refdgs
