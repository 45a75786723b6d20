// A small multilayer perceptron on many points: hidden layers of 64 with ReLU, a linear or exponential end.
#pragma once
#include <cstdint>

namespace refdgs {

constexpr int kHidden = 64;
constexpr int kMlpBlock = 64;        // points whose activations are held at once
constexpr int kMlpInputs = 32;       // at most
constexpr int kMlpOutputs = 4;       // at most; narrower ends are padded with zeros
constexpr int kMlpColumns = 16;      // columns are padded to this, a multiple of every vector's width
constexpr int kMlpHiddenLayers = 8;  // at most

struct MlpShape {
  int inputs, hidden_layers, outputs;
};

// Weights for reading along either side, padded with zeros, and where their gradients go.
template <class S> struct MlpLayer {
  int inputs, outputs;        // padded: rows and columns that are computed
  int input_stride, stride;   // of `weights` and of `transposed`
  S* weights;                 // [outputs][input_stride]
  S* transposed;              // [inputs][stride]
  S* bias;                    // [stride]
};

// Points' inputs, or their gradients, side by side in some tables: element (i, c) at i * row + c * column.
constexpr int kMlpTables = 4;
template <class S> struct MlpTable {
  S* data;
  int64_t row, column;
  int width;
};
template <class S> struct MlpTables {
  int count;
  MlpTable<S> of[kMlpTables];
};

template <class S> struct MlpFrame {
  MlpShape shape;
  MlpLayer<S> layer[kMlpHiddenLayers + 1];
  bool has_exp;         // the output is exp(min(y, cap))
  S cap, largest;       // and exp(cap)
  MlpTables<const S> x;
  S* out;               // [points][outputs]
  const S* v_out;       // [points][outputs]
  MlpTables<S> v_x;     // none: not wanted
  uint32_t* kept;       // [blocks][hidden layers][kMlpPairs] hidden values of half products, may be null
};

// Scalars of a thread's working memory, which must be aligned to 64 bytes: of the exact kernels, and of
// those with bfloat16 products, which need room for as many pairs beside it.
constexpr int64_t kMlpScratch =
    int64_t(kMlpBlock) * (kMlpInputs + kHidden * (kMlpHiddenLayers + 2) + kMlpColumns + kMlpInputs);
constexpr int64_t kMlpPairs = int64_t(kMlpBlock) * kHidden / 2;  // of a block's values, or a layer's weights
constexpr int64_t kMlpHalfScratch = kMlpScratch + (4 * kMlpHiddenLayers + 4) * kMlpPairs;

// Gradients of all layers' weights and biases in one run, laid out as MlpLayer's `weights` and `bias`.
template <class S> struct MlpGrads {
  S* weights[kMlpHiddenLayers + 1];
  S* bias[kMlpHiddenLayers + 1];
};

template <class S> struct MlpKernels {
  void (*forward)(const MlpFrame<S>&, int64_t begin, int64_t end, S* scratch);
  void (*backward)(const MlpFrame<S>&, int64_t begin, int64_t end, S* scratch, const MlpGrads<S>& grads);
};

// Torch's own layouts: weights[l] is (outputs, inputs), one after the other.
template <class S> struct MlpParameters {
  S *weights[kMlpHiddenLayers + 1], *bias[kMlpHiddenLayers + 1];
};

struct MlpPoints {
  int64_t count;
  bool has_exp;
  double cap;
  bool half;
  uint32_t* kept;  // hidden values from forward to backward: mlp_kept() numbers, or null to compute them again
};

// Numbers that `kept` needs; 0 where hidden values are not kept: with float products.
int64_t mlp_kept(const MlpShape& shape, int64_t count, bool half);

// With points.half, float products are of bfloat16 numbers where the CPU has such (`half_products`).
template <class S>
void mlp(const MlpShape& shape, const MlpPoints& points, const MlpTables<const S>& x,
         const MlpParameters<const S>& net, int threads, S* out);
template <class S>
void mlp_bwd(const MlpShape& shape, const MlpPoints& points, const MlpTables<const S>& x,
             const MlpParameters<const S>& net, int threads, S* out, const S* v_out, const MlpTables<S>& v_x,
             const MlpParameters<S>& v_net);

}  // namespace refdgs
