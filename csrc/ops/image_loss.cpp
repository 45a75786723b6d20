#include "image_loss.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "dispatch.h"
#include "parallel.h"

namespace refdgs {

namespace {

LossKernel<float> band_kernel(float) { return kernels().loss_band; }
LossKernel<double> band_kernel(double) { return loss_band_double; }

template <class S> void fill_taps(S* taps) {
  double raw[kLossTaps], sum = 0;
  for (int k = 0; k < kLossTaps; ++k) {
    const double d = k - kLossReach;
    sum += raw[k] = std::exp(-d * d / (2 * 1.5 * 1.5));
  }
  for (int k = 0; k < kLossTaps; ++k) taps[k] = S(raw[k] / sum);
}

}  // namespace

template <class S> void image_loss(LossFrame<S> frame, int threads, double* sums) {
  fill_taps(frame.taps);
  const LossKernel<S> work = band_kernel(S(0));
  const int bands = (frame.height + kLossBand - 1) / kLossBand, tasks = bands * frame.channels;
  std::vector<std::vector<S>> scratch(size_t(std::max(1, threads)));
  std::vector<double> parts(size_t(kLossSums * tasks), 0.0);
  parallel_for_dynamic(tasks, threads, [&](int64_t task, int thread) {
    auto& mine = scratch[size_t(thread)];
    if (mine.empty()) mine.assign(size_t(loss_scratch(frame.width)), S(0));
    work(frame, int(task / bands), int(task % bands), mine.data(), parts.data() + kLossSums * task);
  });
  for (int k = 0; k < kLossSums; ++k) {
    sums[k] = 0;
    for (int task = 0; task < tasks; ++task) sums[k] += parts[kLossSums * task + k];
  }
}

template void image_loss<float>(LossFrame<float>, int, double*);
template void image_loss<double>(LossFrame<double>, int, double*);

}  // namespace refdgs
