// The steps of mlp.h on any queue; included by one file for each.
#include "mlp_half.h"
#include "mlp_kernels.h"

namespace refdgs::cuda {

template <class S, class Queue> void mlp(const Queue& q, const MlpCall<S>& call) {
  const int64_t tiles = blocks_for(call.points.count, kMlpPoints);
  if (call.points.half && fits_half(call.shape)) {
    const int64_t blocks = tiles < 2 * call.blocks ? tiles : 2 * call.blocks;
    return q.run(blocks, MlpForwardHalf<S>{call, blocks});
  }
  if (call.tensor_cores) q.run(tiles, MlpForward<S, MmaProduct>{call});
  else q.run(tiles, MlpForward<S, FmaProduct>{call});
}

template <class S, class Queue> void mlp_bwd(const Queue& q, const MlpCall<S>& call) {
  if (call.points.half && fits_half(call.shape)) q.run(call.blocks, MlpBackwardHalf<S>{call});
  else if (call.tensor_cores) q.run(call.blocks, MlpBackward<S, MmaProduct>{call});
  else q.run(call.blocks, MlpBackward<S, FmaProduct>{call});
  q.run(blocks_for(call.numbers(), kWarp), SumParts<S>{call});
}

#define REFDGS_MLP(S, Queue)                                       \
  template void mlp<S, Queue>(const Queue&, const MlpCall<S>&);    \
  template void mlp_bwd<S, Queue>(const Queue&, const MlpCall<S>&);

}  // namespace refdgs::cuda
