// What a training photo, kept as bytes, asks of a render: its colours over a backdrop, and its mask's cross-entropy.
#pragma once
#include <cstdint>

#include "image_loss.h"  // Image

namespace refdgs {

constexpr int kPhotoBand = 16;  // image rows of one task, whatever the threads

struct Photo {
  int width, height;
  const uint8_t* rgb;   // [3][H][W]
  const uint8_t* mask;  // [H][W], null: all of the object
};

// rgb mask + (1 - mask) backdrop, in 0..1, planes [3][H][W]; backdrop: 3 numbers.
template <class S> void composited(const Photo& photo, const S* backdrop, int threads, S* out);

// The sum over pixels of -(m ln a + (1 - m) ln(1 - a)), a clamped to 1e-4..1-1e-4, and gradients of scale times it.
template <class S> struct MaskEntropy {
  int width, height;
  Image<S> alpha;
  const uint8_t* mask;  // [H][W]
  S scale;
  S* v_alpha;  // [H][W], may be null
};
template <class S> double mask_entropy(const MaskEntropy<S>& in, int threads);

template <class S> struct PhotoKernels {
  void (*composited)(const Photo&, const S* backdrop, int64_t first, int64_t last, S* out);  // pixels
  double (*mask_entropy)(const MaskEntropy<S>&, int64_t first, int64_t last);                // rows
};

}  // namespace refdgs
