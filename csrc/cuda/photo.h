// The operations of ops/photo.h on the grid; a sum stays on the device.
#pragma once
#include "../math/vec.h"
#include "../ops/photo.h"
#include "queue.h"

namespace refdgs::cuda {

constexpr int kPhotoThreads = 256;  // pixels of a block, whose sums come to one part

// backdrop: [3] on the device.
template <class S, class Queue> void composited(const Queue& q, const Photo& photo, const S* backdrop, S* out);
// parts: of in.scale times the sum, one for each kPhotoThreads pixels; loss: [1] their sum, or null.
template <class S, class Queue> void mask_entropy(const Queue& q, const MaskEntropy<S>& in, S* parts, S* loss);

}  // namespace refdgs::cuda
