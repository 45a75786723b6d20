// The kernels of adam.h, and their launches on any queue; included by one file for each.
//
// 28 bytes a number: 14 numbers of 130,000 surfels and 0.5 M of a map are 65 MB, 15 us at 4.3 TB/s; arithmetic does not
// count. One launch in place of three or four for every tensor, which the CPU could not keep up with.
#include "adam.h"
#include "grid.h"

namespace refdgs::cuda {

// A block: kAdamEach numbers of one tensor.
template <class S> struct AdamUpdate {
  static constexpr int kThreads = 256;
  struct Shared {
    S by_mean, by_square;
  };
  AdamCall<S> f;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared& s) const {
    if (f.skipped()) return;
    int k = 0;
    while (t.block() >= f.tensor[k].end) ++k;
    const AdamTensor<S>& mine = f.tensor[k];
    if (t.thread() == 0) {  // both biases need the digits of a double
      const double step = double(*mine.step) + 1;
      s.by_mean = S(double(mine.rate_at ? *mine.rate_at : mine.rate) / -std::expm1(step * std::log(f.beta1)));
      s.by_square = S(1 / std::sqrt(-std::expm1(step * std::log(f.beta2))));
    }
    t.sync();
    const int64_t begin = int64_t(t.block() - (k ? f.tensor[k - 1].end : 0)) * kAdamEach;
    const S beta1 = S(f.beta1), beta2 = S(f.beta2), rest1 = S(1 - f.beta1), rest2 = S(1 - f.beta2);
    for (int64_t i = begin + t.thread(); i < begin + kAdamEach && i < mine.count; i += kThreads) {
      const S g = mine.gradient[i];
      const S mean = mine.mean[i] = beta1 * mine.mean[i] + rest1 * g;
      const S square = mine.square[i] = beta2 * mine.square[i] + rest2 * g * g;
      mine.values[i] -= s.by_mean * mean / (std::sqrt(square) * s.by_square + f.epsilon);
    }
  }
};

// Then one thread for each tensor counts the step.
template <class S> struct AdamCount {
  static constexpr int kThreads = kAdamTensors;
  using Shared = Nothing;
  AdamCall<S> f;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared&) const {
    if (t.thread() < f.tensors && !f.skipped()) *f.tensor[t.thread()].step += 1;
  }
};

template <class S, class Queue> void adam(const Queue& q, AdamCall<S> call) {
  int64_t blocks = 0;
  for (int k = 0; k < call.tensors; ++k) {
    blocks += blocks_for(call.tensor[k].count, kAdamEach);
    call.tensor[k].end = int32_t(blocks);
  }
  q.run(blocks, AdamUpdate<S>{call});
  q.run(call.tensors ? 1 : 0, AdamCount<S>{call});
}

#define REFDGS_ADAM(S, Queue) template void adam<S, Queue>(const Queue&, AdamCall<S>);

}  // namespace refdgs::cuda
