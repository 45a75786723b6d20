// The steps of image_loss.h on any queue; included by one file for each.
#include <cmath>

#include "image_loss_kernels.h"

namespace refdgs::cuda {

template <class S, class Queue> void image_loss(const Queue& q, LossCall<S> call) {
  double raw[kLossTaps], sum = 0;
  for (int k = 0; k < kLossTaps; ++k) {
    const double d = k - kLossReach;
    sum += raw[k] = std::exp(-d * d / (2 * 1.5 * 1.5));
  }
  for (int k = 0; k < kLossTaps; ++k) call.taps[k] = S(raw[k] / sum);
  q.run(call.blocks(), CompareTiles<S>{call});
  q.run(1, FinishLoss<S>{call});
  if (call.gradient) q.run(call.blocks(), LossGradient<S>{call});
}

#define REFDGS_IMAGE_LOSS(S, Queue) template void image_loss<S, Queue>(const Queue&, LossCall<S>);

}  // namespace refdgs::cuda
