// The operations of ops/shade.h on the grid; a sum stays on the device.
#pragma once
#include "lens.h"
#include "queue.h"

namespace refdgs::cuda {

constexpr int kAgreementThreads = 256;  // pixels of a block, whose sums come to one part

constexpr int kCoveredThreads = 256;    // pixels of a block that are counted together

constexpr int kSmoothWide = 32, kSmoothHigh = 8;  // pixels of a block's tile, whose sums come to one part

// The pixels where alpha is above `least`, in ascending order, then -1. What follows does nothing for those.
template <class S> struct CoveredCall {
  int width, height;
  Image<S> alpha;
  S least;
  int64_t room;
  int64_t* pixels;  // [room]
  int64_t* counts;  // [blocks() + 1] scratch; the last becomes the number of pixels
  int64_t* needed;  // [1] the same, for who planned the room
  float* misfit;    // [1] becomes 1 where they do not fit
  REFDGS_HD int64_t plane() const { return int64_t(width) * height; }
  REFDGS_HD int64_t blocks() const { return (plane() + kCoveredThreads - 1) / kCoveredThreads; }
};
template <class S, class Queue>
void covered_pixels(const Queue& q, const CoveredCall<S>& call, void* scratch, int64_t bytes);

// lens: see lens.h; may be null.
template <class S, class Queue>
void shading_inputs(const Queue& q, const Covered<S>& at, const S* lens, const Inputs<S>& out);
// Clears the gradients, which lie one after the other from that of features on, then writes covered pixels.
template <class S, class Queue>
void shading_inputs_bwd(const Queue& q, const Covered<S>& at, const S* lens, const Inputs<const S>& v,
                        const MapGrads<S>& grads);
// backdrop: [3] on the device.
template <class S, class Queue>
void composite(const Queue& q, const Composite<S>& in, const S* backdrop, S* image);
// v_linear: [count][3]; v_object_alpha: may be v_alpha, for the sum of both.
template <class S, class Queue>
void composite_bwd(const Queue& q, const Composite<S>& in, const S* backdrop, Image<S> v_image, S* v_linear,
                   S* v_object_alpha, S* v_alpha);
// slopes: [6][H][W] scratch, null with the gradients; parts: of in.scale times the sum, one for each kAgreementThreads
// pixels; sum: [1] their sum, or null.
template <class S, class Queue>
void normal_agreement(const Queue& q, const Agreement<S>& in, const S* lens, S* slopes, S* parts, S* sum);
// parts: one for each tile of kSmoothWide x kSmoothHigh pixels; sum: [1] their sum, or null.
template <class S, class Queue>
void normal_smoothness(const Queue& q, const Smoothness<S>& in, S* parts, S* sum);

}  // namespace refdgs::cuda
