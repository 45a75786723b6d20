// The deferred shading around the shader's network, per covered pixel: what it is given, how its result becomes
// a picture, and how far splatted normals are from those of the depth map. Elementwise, bound by memory.
#pragma once
#include <cstdint>

#include "../math/vec.h"
#include "image_loss.h"  // Image

namespace refdgs {

constexpr int kShadeBand = 16;  // image rows of one task, whatever the threads

template <class S> struct View {
  int width, height;
  S fx, fy, cx, cy;
  Mat3<S> world_from_cam;
};

// Numbers of the covered pixels, [count][C]: element (i, c) at i * row + c * column.
template <class S> struct Rows {
  S* data;
  int64_t row, column;
};

// Features, normal and near are premultiplied by alpha, as splatted; near.data may be null.
template <class S> struct Covered {
  View<S> view;
  int64_t count;
  const int64_t* pixels;  // row * width + column, ascending
  int channels;           // of features
  Image<S> features, alpha, normal, near;
};

// Features / alpha: diffuse [3] and roughness; unit mirrored ray [3], cosine in 0..1, near as it is [4].
template <class S> struct Inputs {
  Rows<S> diffuse, roughness, reflected, cosine, near;
};

template <class S> void shading_inputs(const Covered<S>& at, int threads, const Inputs<S>& out);

// Gradients by plane [C][H][W], zero where nothing is covered.
template <class S> struct MapGrads {
  S *features, *alpha, *normal, *near;
};
template <class S>
void shading_inputs_bwd(const Covered<S>& at, const Inputs<const S>& v_out, int threads, const MapGrads<S>& grads);

// image = object_alpha srgb(diffuse + radiance) + (1 - alpha) backdrop + behind, planes [3][H][W].
template <class S> struct Composite {
  int width, height;
  int64_t count;
  const int64_t* pixels;  // as above
  Rows<const S> diffuse, radiance;
  Image<S> object_alpha, alpha, behind;  // behind.data may be null
  S backdrop[3];
};

template <class S> void composite(const Composite<S>& in, int threads, S* image);
// v_linear: of diffuse and of radiance, [3][count].
template <class S>
void composite_bwd(const Composite<S>& in, Image<S> v_image, int threads, S* v_linear, S* v_object_alpha, S* v_alpha);

// Sum of alpha (1 - n . n_depth) over pixels with four neighbours that lie on one surface: the depth's second
// differences are below `edge` pixel footprints. Gradients of scale times it, by plane.
template <class S> struct Agreement {
  View<S> view;
  Image<S> normal, depth, alpha;  // sums of w n, of w z, of w
  S scale, edge;
  S *v_normal, *v_depth, *v_alpha;  // all null if not wanted
};
template <class S> double normal_agreement(const Agreement<S>& in, int threads);

// Sum over neighbours p, q of scale |n_p - n_q|, damped at edges of the diffuse colour features / object_alpha (0 where
// that is at most `shaded`) and of the depth, where both have an alpha above kSolid. Its gradient, if wanted.
template <class S> struct Smoothness {
  int width, height;
  Image<S> normal, features, depth, alpha, object_alpha;  // sums of w n, of w (diffuse, ...), of w z, of w
  S shaded, scale_x, scale_y;                             // scales of steps to the right and down
  S* v_normal;                                            // [3][H][W], may be null
};
template <class S> double normal_smoothness(const Smoothness<S>& in, int threads);
constexpr double kSolid = 0.9, kDiffuseEdge = 10, kDepthEdge = 100;

// Image rows, and the covered pixels on them.
struct Band {
  int first, last;
  int64_t begin, end;
};
constexpr int kSlopeRows = 3;  // rows of normal_agreement's ring
static inline int64_t slope_row(int width) { return (width + 15) / 16 * 16; }
static inline int64_t slope_scratch(int width) { return kSlopeRows * 6 * slope_row(width); }

template <class S> struct ShadeKernels {
  void (*inputs)(const Covered<S>&, Band, const Inputs<S>& out);
  void (*inputs_bwd)(const Covered<S>&, Band, const Inputs<const S>& v_out, const MapGrads<S>&);
  void (*composite)(const Composite<S>&, Band, S* image);
  void (*composite_bwd)(const Composite<S>&, Band, const Image<S>& v_image, S* v_linear, S* v_object_alpha,
                        S* v_alpha);
  // sums: [last - first], each row's; scratch: slope_scratch, aligned to 64 bytes.
  void (*agreement)(const Agreement<S>&, Band, S* scratch, double* sums);
  void (*smoothness)(const Smoothness<S>&, Band, double* sums);
};

}  // namespace refdgs
