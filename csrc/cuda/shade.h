// The operations of ops/shade.h on the grid; a sum stays on the device.
#pragma once
#include "../ops/shade.h"
#include "queue.h"

namespace refdgs::cuda {

constexpr int kAgreementThreads = 256;  // pixels of a block, whose sums come to one part

template <class S, class Queue>
void shading_inputs(const Queue& q, const Covered<S>& at, const Inputs<S>& out);
// Writes covered pixels only: elsewhere the gradients must be zero before.
template <class S, class Queue>
void shading_inputs_bwd(const Queue& q, const Covered<S>& at, const Inputs<const S>& v, const MapGrads<S>& grads);
// backdrop: [3] on the device.
template <class S, class Queue>
void composite(const Queue& q, const Composite<S>& in, const S* backdrop, S* image);
template <class S, class Queue>
void composite_bwd(const Queue& q, const Composite<S>& in, const S* backdrop, Image<S> v_image, S* v_linear,
                   S* v_object_alpha, S* v_alpha);
// slopes: [6][H][W] scratch, null with the gradients; parts: one for each kAgreementThreads pixels; sum: [1].
template <class S, class Queue>
void normal_agreement(const Queue& q, const Agreement<S>& in, S* slopes, S* parts, S* sum);

}  // namespace refdgs::cuda
