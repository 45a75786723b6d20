// L1 + SSIM on the grid: what ops/image_loss.h computes, its sums left on the device.
#pragma once
#include "../math/vec.h"
#include "../ops/image_loss.h"
#include "queue.h"

namespace refdgs::cuda {

constexpr int kLossTile = 16;  // pixels along the edge of a block's tile

template <class S> struct LossCall {
  int width, height, channels;
  Image<S> image, target;
  const S* weight;  // [H][W], or null for ones
  const S* each;    // [1] what one unit of weight counts for; null: `constant`
  S constant;
  S l1_share, ssim_share;
  S taps[kLossTaps];
  S* slopes;        // [3][C][H][W] scratch, null without a gradient
  S* gradient;      // [C][H][W], may be null
  S* map;           // [C][H][W] SSIM, may be null
  S* parts;         // [blocks][kLossSums] scratch
  S* sums;          // [kLossSums] as on the CPU
  S* loss;          // [1] shares of the first two times `each`, and ssim_share's part of what no pixel changes
  S* error;         // [1] the third times `each`; null with `loss`

  REFDGS_HD S unit() const { return each ? *each : constant; }
  REFDGS_HD int across() const { return (width + kLossTile - 1) / kLossTile; }
  REFDGS_HD int down() const { return (height + kLossTile - 1) / kLossTile; }
  REFDGS_HD int blocks() const { return across() * down() * channels; }
};

// Fills call.taps.
template <class S, class Queue> void image_loss(const Queue& q, LossCall<S> call);

}  // namespace refdgs::cuda
