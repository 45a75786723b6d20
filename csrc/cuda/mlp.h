// The shader's network on the grid: what ops/mlp.h computes.
#pragma once
#include "../math/vec.h"
#include "../ops/mlp.h"
#include "queue.h"

namespace refdgs::cuda {

constexpr int kMlpPoints = 64;          // of a tile
constexpr int kMlpThreads = 256;        // of a block
constexpr int kMlpSide = kMlpPoints + 4;  // scalars between rows in shared memory: no two rows start in one bank

template <class S> struct MlpCall {
  MlpShape shape;
  MlpPoints points;
  MlpTables<const S> x;  // side by side
  const int64_t* limit;  // [1] only the first that many points are looked at; null: all
  MlpParameters<const S> net;
  S cap, largest;  // of the exponential, and exp(cap)
  int blocks;      // that share the tiles; backward has a part of `hidden` and `parts` for each
  bool tensor_cores;  // for the hidden layers' products; of bfloat16 numbers if points.half (mlp_half.h)
  S* out;          // [points][outputs]
  const S* v_out;  // [points][outputs]
  MlpTables<S> v_x;  // none: not wanted
  S* hidden;       // [blocks][hidden layers][kHidden][kMlpPoints] scratch of backward
  S* parts;        // [blocks][numbers()] of the gradients of weights and biases, layer by layer
  MlpParameters<S> v_net;

  REFDGS_HD S x_at(int64_t point, int c) const {
    int k = 0;
    for (; c >= x.of[k].width; ++k) c -= x.of[k].width;
    return x.of[k].data[point * x.of[k].row + c * x.of[k].column];
  }
  REFDGS_HD void set_v_x(int64_t point, int c, S value) const {
    int k = 0;
    for (; c >= v_x.of[k].width; ++k) c -= v_x.of[k].width;
    v_x.of[k].data[point * v_x.of[k].row + c * v_x.of[k].column] = value;
  }
  REFDGS_HD int64_t count() const { return limit && *limit < points.count ? *limit : points.count; }
  REFDGS_HD int inputs(int l) const { return l ? kHidden : shape.inputs; }
  REFDGS_HD int outputs(int l) const { return l < shape.hidden_layers ? kHidden : shape.outputs; }
  // Where the gradient of layer l's weights starts in a part; its bias follows. Of the last layer: the part's length.
  REFDGS_HD int start(int l) const {
    int used = 0;
    for (int k = 0; k < l; ++k) used += outputs(k) * (inputs(k) + 1);
    return used;
  }
  REFDGS_HD int numbers() const { return start(shape.hidden_layers + 1); }
};

template <class S, class Queue> void mlp(const Queue& q, const MlpCall<S>& call);
template <class S, class Queue> void mlp_bwd(const Queue& q, const MlpCall<S>& call);

}  // namespace refdgs::cuda
