// The steps of shade.h on any queue; included by one file for each.
#include "shade_kernels.h"
#include "smooth_kernels.h"

namespace refdgs::cuda {

template <class S, class Queue>
void covered_pixels(const Queue& q, const CoveredCall<S>& call, void* scratch, int64_t bytes) {
  q.run(call.blocks() + 1, CountCovered<S>{call});
  q.scan(call.counts, call.blocks() + 1, scratch, size_t(bytes));
  q.run(call.blocks(), WriteCovered<S>{call});
}

template <class S, class Queue>
void shading_inputs(const Queue& q, const Covered<S>& at, const S* lens, const Inputs<S>& out) {
  q.run(blocks_for(at.count, GatherInputs<S>::kThreads), GatherInputs<S>{at, lens, out});
}

template <class S, class Queue>
void shading_inputs_bwd(const Queue& q, const Covered<S>& at, const S* lens, const Inputs<const S>& v,
                        const MapGrads<S>& grads) {
  const int64_t planes = at.channels + 4 + (at.near.data ? 4 : 0);
  q.zero(grads.features, size_t(planes * at.view.width * at.view.height) * sizeof(S));
  q.run(blocks_for(at.count, GatherInputsBwd<S>::kThreads), GatherInputsBwd<S>{at, lens, v, grads});
}

template <class S, class Queue>
void composite(const Queue& q, const Composite<S>& in, const S* backdrop, S* image) {
  const int64_t plane = int64_t(in.width) * in.height;
  q.run(blocks_for(plane, ComposeBehind<S>::kThreads), ComposeBehind<S>{in, backdrop, image});
  q.run(blocks_for(in.count, ComposeObject<S>::kThreads), ComposeObject<S>{in, image});
}

template <class S, class Queue>
void composite_bwd(const Queue& q, const Composite<S>& in, const S* backdrop, Image<S> v_image, S* v_linear,
                   S* v_object_alpha, S* v_alpha) {
  const int64_t plane = int64_t(in.width) * in.height;
  q.run(blocks_for(plane, ComposeBehindBwd<S>::kThreads),
        ComposeBehindBwd<S>{in, backdrop, v_image, v_object_alpha, v_alpha});
  q.run(blocks_for(in.count, ComposeObjectBwd<S>::kThreads), ComposeObjectBwd<S>{in, v_image, v_linear, v_object_alpha});
}

template <class S, class Queue>
void normal_agreement(const Queue& q, const Agreement<S>& in, const S* lens, S* slopes, S* parts, S* sum) {
  const int64_t plane = int64_t(in.view.width) * in.view.height, blocks = blocks_for(plane, kAgreementThreads);
  q.run(blocks, AgreeNormals<S>{in, lens, slopes, parts});
  if (sum) q.run(1, SumRows<S>{parts, blocks, 1, sum});
  if (slopes) q.run(blocks_for(plane, AgreeNormalsBwd<S>::kThreads), AgreeNormalsBwd<S>{in, lens, slopes});
}

template <class S, class Queue>
void normal_smoothness(const Queue& q, const Smoothness<S>& in, S* parts, S* sum) {
  const int64_t blocks = blocks_for(in.width, kSmoothWide) * blocks_for(in.height, kSmoothHigh);
  q.run(blocks, SmoothNormals<S>{in, parts});
  if (sum) q.run(1, SumRows<S>{parts, blocks, 1, sum});
}

#define REFDGS_SHADE(S, Queue)                                                                               \
  template void covered_pixels<S, Queue>(const Queue&, const CoveredCall<S>&, void*, int64_t);               \
  template void shading_inputs<S, Queue>(const Queue&, const Covered<S>&, const S*, const Inputs<S>&);       \
  template void shading_inputs_bwd<S, Queue>(const Queue&, const Covered<S>&, const S*,                      \
                                             const Inputs<const S>&, const MapGrads<S>&);                    \
  template void composite<S, Queue>(const Queue&, const Composite<S>&, const S*, S*);                        \
  template void composite_bwd<S, Queue>(const Queue&, const Composite<S>&, const S*, Image<S>, S*, S*, S*);  \
  template void normal_agreement<S, Queue>(const Queue&, const Agreement<S>&, const S*, S*, S*, S*);         \
  template void normal_smoothness<S, Queue>(const Queue&, const Smoothness<S>&, S*, S*);

}  // namespace refdgs::cuda
