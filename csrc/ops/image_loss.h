// The mean of (1 - s) |x - y| + s (1 - SSIM(x, y)) of two images and its gradient, in one pass.
#pragma once
#include <cstdint>

namespace refdgs {

constexpr int kLossTaps = 11, kLossReach = 5;  // the Gaussian window of SSIM (Wang et al. 2004)
constexpr int kLossBand = 64;                  // output rows of one task, whatever the threads
constexpr int kLossPad = 16;                   // zeros left and right of a scratch row

template <class S> struct Image {
  const S* data;
  int64_t row, column, channel;  // strides, in scalars
};

template <class S> struct LossFrame {
  int width, height, channels;
  Image<S> image, target;
  const S* weight;  // [H][W], or null for ones
  S taps[kLossTaps];
  S l1_scale, ssim_scale;  // what the two sums count for in the loss
  S* gradient;             // [C][H][W] of the loss with respect to image, may be null
  S* map;                  // [C][H][W] SSIM, may be null
};

// Scalars of working memory, all zero before the first call with it. Static: every instruction set its own.
static inline int64_t loss_row(int width) { return (width + 15) / 16 * 16 + 2 * kLossPad; }
static inline int64_t loss_scratch(int width) { return loss_row(width) * (5 * kLossTaps + 8); }

// One channel of one band of rows; sums, all weighted: |x - y|, SSIM, (x - y)^2.
constexpr int kLossSums = 3;
template <class S>
using LossKernel = void (*)(const LossFrame<S>&, int channel, int band, S* scratch, double* sums);

// Fills frame.taps; returns the weighted sums over the image. They do not depend on the threads.
template <class S> void image_loss(LossFrame<S> frame, int threads, double* sums);

}  // namespace refdgs
