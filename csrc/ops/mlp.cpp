#include "mlp.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "buffer.h"
#include "dispatch.h"
#include "parallel.h"

namespace refdgs {

namespace {

constexpr int64_t kChunk = 2048;  // points whose weight gradients are summed together, whatever the threads

MlpKernels<float> point_kernels(float, bool half) {
  const MlpKernels<float>* products = half ? half_products() : nullptr;
  return products ? *products : kernels().mlp;
}
MlpKernels<double> point_kernels(double, bool) { return mlp_kernels_double(); }

int64_t padded(int64_t n) { return (n + kMlpColumns - 1) / kMlpColumns * kMlpColumns; }

struct Sizes {
  int inputs, outputs;  // of a layer, in torch's layout
};
Sizes layer_sizes(const MlpShape& shape, int l) {
  return {l ? kHidden : shape.inputs, l < shape.hidden_layers ? kHidden : shape.outputs};
}
MlpLayer<char> padded_sizes(const MlpShape& shape, int l) {
  const Sizes s = layer_sizes(shape, l);
  const int outputs = l < shape.hidden_layers ? kHidden : kMlpOutputs;
  return {s.inputs, outputs, int(padded(s.inputs)), int(padded(outputs)), nullptr, nullptr, nullptr};
}

// Where each layer's gradients lie in one chunk's run of scalars; returns the run's length.
template <class S> int64_t place_grads(const MlpShape& shape, S* run, MlpGrads<S>* grads) {
  int64_t used = 0;
  for (int l = 0; l <= shape.hidden_layers; ++l) {
    const auto p = padded_sizes(shape, l);
    if (grads) grads->weights[l] = run + used, grads->bias[l] = run + used + int64_t(p.outputs) * p.input_stride;
    used += int64_t(p.outputs) * p.input_stride + p.stride;
  }
  return used;
}

template <class S> void pack(const MlpParameters<const S>& net, MlpFrame<S>& frame, Buffer<S>& memory) {
  int64_t size = 0;
  for (int l = 0; l <= frame.shape.hidden_layers; ++l) {
    const auto p = padded_sizes(frame.shape, l);
    size += int64_t(p.outputs) * p.input_stride + int64_t(p.inputs) * p.stride + p.stride;
  }
  memory.make(size);
  S* next = memory.data;
  for (int l = 0; l <= frame.shape.hidden_layers; ++l) {
    const auto p = padded_sizes(frame.shape, l);
    const Sizes s = layer_sizes(frame.shape, l);
    MlpLayer<S>& layer = frame.layer[l];
    layer = {p.inputs, p.outputs, p.input_stride, p.stride, next, nullptr, nullptr};
    layer.transposed = layer.weights + int64_t(p.outputs) * p.input_stride;
    layer.bias = layer.transposed + int64_t(p.inputs) * p.stride;
    next = layer.bias + p.stride;
    for (int o = 0; o < s.outputs; ++o) {
      layer.bias[o] = net.bias[l][o];
      for (int i = 0; i < s.inputs; ++i)
        layer.weights[o * p.input_stride + i] = layer.transposed[i * p.stride + o] = net.weights[l][o * s.inputs + i];
    }
  }
}

template <class S>
MlpFrame<S> make_frame(const MlpShape& shape, const MlpPoints& points, const MlpTables<const S>& x,
                       const MlpParameters<const S>& net, Buffer<S>& memory) {
  MlpFrame<S> frame{};
  frame.shape = shape;
  frame.has_exp = points.has_exp;
  frame.cap = S(points.cap);
  frame.largest = std::exp(frame.cap);
  frame.x = x;
  frame.kept = points.kept;
  pack(net, frame, memory);
  return frame;
}

// body(chunk, begin, end, scratch) on every chunk.
template <class S, class F> void each_chunk(int64_t count, int threads, F&& body) {
  std::vector<Buffer<S>> scratch(size_t(std::max(1, threads)));
  parallel_for_dynamic((count + kChunk - 1) / kChunk, threads, [&](int64_t chunk, int thread) {
    Buffer<S>& mine = scratch[size_t(thread)];
    if (!mine.data) mine.make(kMlpHalfScratch);
    body(chunk, chunk * kChunk, std::min(count, (chunk + 1) * kChunk), mine.data);
  });
}

}  // namespace

int64_t mlp_kept(const MlpShape& shape, int64_t count, bool half) {
  return half && half_products() ? (count + kMlpBlock - 1) / kMlpBlock * shape.hidden_layers * kMlpPairs : 0;
}

template <class S>
void mlp(const MlpShape& shape, const MlpPoints& points, const MlpTables<const S>& x,
         const MlpParameters<const S>& net, int threads, S* out) {
  Buffer<S> memory;
  MlpFrame<S> frame = make_frame(shape, points, x, net, memory);
  frame.out = out;
  const auto run = point_kernels(S(0), points.half).forward;
  each_chunk<S>(points.count, threads,
                [&](int64_t, int64_t begin, int64_t end, S* scratch) { run(frame, begin, end, scratch); });
}

template <class S>
void mlp_bwd(const MlpShape& shape, const MlpPoints& points, const MlpTables<const S>& x,
             const MlpParameters<const S>& net, int threads, S* out, const S* v_out, const MlpTables<S>& v_x,
             const MlpParameters<S>& v_net) {
  Buffer<S> memory, sums;
  MlpFrame<S> frame = make_frame(shape, points, x, net, memory);
  frame.out = out, frame.v_out = v_out, frame.v_x = v_x;
  const int64_t chunks = std::max<int64_t>(1, (points.count + kChunk - 1) / kChunk);
  const int64_t size = place_grads<S>(shape, nullptr, nullptr);
  sums.make(chunks * size);
  const auto run = point_kernels(S(0), points.half).backward;
  each_chunk<S>(points.count, threads, [&](int64_t chunk, int64_t begin, int64_t end, S* scratch) {
    MlpGrads<S> grads;
    place_grads(shape, sums.data + chunk * size, &grads);
    run(frame, begin, end, scratch, grads);
  });
  parallel_for(size, threads, [&](int64_t i) {
    double sum = 0;
    for (int64_t chunk = 0; chunk < chunks; ++chunk) sum += double(sums.data[chunk * size + i]);
    sums.data[i] = S(sum);
  });
  MlpGrads<S> total;
  place_grads(shape, sums.data, &total);
  for (int l = 0; l <= shape.hidden_layers; ++l) {
    const Sizes s = layer_sizes(shape, l);
    const int64_t stride = padded(s.inputs);
    std::copy(total.bias[l], total.bias[l] + s.outputs, v_net.bias[l]);
    for (int o = 0; o < s.outputs; ++o)
      std::copy(total.weights[l] + o * stride, total.weights[l] + o * stride + s.inputs,
                v_net.weights[l] + int64_t(o) * s.inputs);
  }
}

#define REFDGS_MLP(S)                                                                                              \
  template void mlp<S>(const MlpShape&, const MlpPoints&, const MlpTables<const S>&, const MlpParameters<const S>&, \
                       int, S*);                                                                                   \
  template void mlp_bwd<S>(const MlpShape&, const MlpPoints&, const MlpTables<const S>&,                           \
                           const MlpParameters<const S>&, int, S*, const S*, const MlpTables<S>&,                  \
                           const MlpParameters<S>&);
REFDGS_MLP(float)
REFDGS_MLP(double)

}  // namespace refdgs
