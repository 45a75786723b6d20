// One step of Adam (Kingma and Ba 2015) for many tensors at once.
#pragma once
#include "../math/vec.h"
#include "queue.h"

namespace refdgs::cuda {

constexpr int kAdamTensors = 32;  // of one launch
constexpr int kAdamEach = 1024;   // numbers of a block

template <class S> struct AdamTensor {
  S* values;
  const S* gradient;
  S *mean, *square;  // running means of the gradient and of its square
  float* step;       // [1] steps taken so far
  const S* rate_at;  // [1] the rate on the device; null: `rate`
  int64_t count;
  S rate;
  int32_t end;       // the block after its last one
};

template <class S> struct AdamCall {
  AdamTensor<S> tensor[kAdamTensors];
  int tensors;
  double beta1, beta2;
  S epsilon;
  const float* misfit;  // [1] where this is 1 nothing changes; may be null

  REFDGS_HD bool skipped() const { return misfit && *misfit != 0; }
};

// Fills in which blocks are whose.
template <class S, class Queue> void adam(const Queue& q, AdamCall<S> call);

}  // namespace refdgs::cuda
