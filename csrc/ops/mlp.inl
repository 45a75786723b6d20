// One call does the points begin..end-1, a block of 64 at a time, whose activations stay in the nearest
// caches; backward recomputes them, which is cheaper than writing and reading them. All three products
// (forward, to the inputs, to the weights) are the same register-blocked one: R rows by V vectors of sums,
// one broadcast per row and one load per vector and step. Activations are stored point by point, so that
// none is ever transposed.

constexpr int kWide = LANES == 16 ? 4 : 2;  // vectors of a tile: 4 rows x V sums fit the registers

template <class S> struct Operand {
  const S* data;
  int64_t row, step;
};

// finish(row, column, start(row, column) + sum over k of a(row, k) b(k, column)).
template <class S, int R, int V, class Start, class Finish>
inline void product(int rows, int columns, int depth, Operand<S> a, const S* b, int64_t b_step, Start start,
                    Finish finish) {
  using vf = typename Simd<S>::vf;
  for (int row = 0; row < rows; row += R)
    for (int column = 0; column < columns; column += V * LANES) {
      vf sum[R][V];
      for (int r = 0; r < R; ++r)
        for (int v = 0; v < V; ++v) sum[r][v] = start(row + r, column + v * LANES);
      const S* pa = a.data + row * a.row;
      const S* pb = b + column;
      for (int k = 0; k < depth; ++k, pa += a.step, pb += b_step) {
        vf vb[V];
        for (int v = 0; v < V; ++v) vb[v] = load(pb + v * LANES);
        for (int r = 0; r < R; ++r) {
          const S x = pa[r * a.row];
          for (int v = 0; v < V; ++v) sum[r][v] += x * vb[v];
        }
      }
      for (int r = 0; r < R; ++r)
        for (int v = 0; v < V; ++v) finish(row + r, column + v * LANES, sum[r][v]);
    }
}

template <class S> struct MlpBlock {
  int points, rows;  // rows: points rounded up to 8, the rest are zero
  S *x, *hidden[kMlpHiddenLayers], *out, *grad[2], *v_x;

  MlpBlock(int64_t begin, int64_t end, S* scratch)
      : points(end - begin < kMlpBlock ? int(end - begin) : kMlpBlock), rows((points + 7) / 8 * 8) {
    x = scratch;
    for (int l = 0; l < kMlpHiddenLayers; ++l) hidden[l] = x + kMlpBlock * (kMlpInputs + l * kHidden);
    grad[0] = x + kMlpBlock * (kMlpInputs + kMlpHiddenLayers * kHidden);
    grad[1] = grad[0] + kMlpBlock * kHidden;
    out = grad[1] + kMlpBlock * kHidden;
    v_x = out + kMlpBlock * kMlpColumns;
  }
};

template <class S> void mlp_read_inputs(const MlpFrame<S>& f, int64_t begin, const MlpBlock<S>& block) {
  const int padded = f.layer[0].input_stride;
  __builtin_memset(block.x, 0, size_t(block.rows) * padded * sizeof(S));
  S* first = block.x;
  for (int k = 0; k < f.x.count; first += f.x.of[k++].width) {
    const MlpTable<const S>& table = f.x.of[k];
    const S* from = table.data + begin * table.row;
    for (int i = 0; i < block.points; ++i, from += table.row) {
      S* to = first + i * padded;
      if (table.width == 4 && table.column == 1)
        __builtin_memcpy(to, from, 4 * sizeof(S));
      else
        for (int c = 0; c < table.width; ++c) to[c] = from[c * table.column];
    }
  }
}

// From rows of kMlpColumns in block.out.
template <class S> void mlp_write_outputs(const MlpFrame<S>& f, int64_t begin, const MlpBlock<S>& block) {
  using vf = typename Simd<S>::vf;
  const int width = f.shape.outputs;
  alignas(64) S flat[kMlpBlock * kMlpOutputs] = {};
  for (int i = 0; i < block.points; ++i)
    for (int c = 0; c < width; ++c) flat[i * width + c] = block.out[i * kMlpColumns + c];
  const int numbers = block.points * width;
  for (int i = 0; f.has_exp && i < numbers; i += LANES) {
    const vf y = load(flat + i);
    store(flat + i, y == y ? f.largest * exp_of(min_of(vf{}, y - f.cap)) : y);  // a NaN stays one
  }
  __builtin_memcpy(f.out + begin * width, flat, size_t(numbers) * sizeof(S));
}

template <class S> void mlp_hidden(const MlpFrame<S>& f, int64_t begin, const MlpBlock<S>& block) {
  using vf = typename Simd<S>::vf;
  mlp_read_inputs(f, begin, block);
  const S* in = block.x;
  int64_t in_row = f.layer[0].input_stride;
  for (int l = 0; l < f.shape.hidden_layers; ++l) {
    const MlpLayer<S>& layer = f.layer[l];
    S* out = block.hidden[l];
    product<S, 4, kWide>(
        block.rows, kHidden, layer.inputs, Operand<S>{in, in_row, 1}, layer.transposed, layer.stride,
        [&](int, int column) { return load(layer.bias + column); },
        [&](int row, int column, vf y) { store(out + row * kHidden + column, max_of(vf{}, y)); });
    in = out;
    in_row = kHidden;
  }
}

template <class S> void mlp_forward(const MlpFrame<S>& f, int64_t begin, int64_t end, S* scratch) {
  using vf = typename Simd<S>::vf;
  const MlpLayer<S>& last = f.layer[f.shape.hidden_layers];
  for (; begin < end; begin += kMlpBlock) {
    const MlpBlock<S> block(begin, end, scratch);
    mlp_hidden(f, begin, block);
    product<S, 8, 1>(
        block.rows, kMlpOutputs, kHidden, Operand<S>{block.hidden[f.shape.hidden_layers - 1], kHidden, 1},
        last.transposed, last.stride, [&](int, int column) { return load(last.bias + column); },
        [&](int row, int column, vf y) { store(block.out + row * kMlpColumns + column, y); });
    mlp_write_outputs(f, begin, block);
  }
}

// The block's gradient with respect to the last layer's outputs, padded with zeros.
template <class S> void mlp_end_vjp(const MlpFrame<S>& f, int64_t begin, const MlpBlock<S>& block) {
  const int width = f.shape.outputs;
  for (int i = 0; i < block.rows; ++i)
    for (int c = 0; c < kMlpOutputs; ++c) {
      S g = 0;
      if (i < block.points && c < width) {
        const int64_t at = (begin + i) * width + c;
        g = f.v_out[at];
        if (f.has_exp) g = f.out[at] < f.largest || g > 0 ? g * f.out[at] : S(0);  // down, never up
      }
      block.out[i * kMlpOutputs + c] = g;
    }
}

// Adds a block's share of one layer's gradient; g: [rows][outputs], in: [rows][inputs].
template <class S, int V>
void mlp_weights_vjp(const MlpLayer<S>& layer, int rows, const S* g, const S* in, S* v_weights, S* v_bias) {
  using vf = typename Simd<S>::vf;
  const int64_t stride = layer.input_stride;
  product<S, 4, V>(
      layer.outputs, layer.input_stride, rows, Operand<S>{g, 1, layer.outputs}, in, stride,
      [&](int row, int column) { return load(v_weights + row * stride + column); },
      [&](int row, int column, vf y) { store(v_weights + row * stride + column, y); });
  for (int c = 0; c < layer.outputs; ++c) {
    if (layer.outputs - c >= LANES) {
      vf sum = load(v_bias + c);
      for (int i = 0; i < rows; ++i) sum += load(g + i * layer.outputs + c);
      store(v_bias + c, sum);
      c += LANES - 1;
      continue;
    }
    for (int i = 0; i < rows; ++i) v_bias[c] += g[i * layer.outputs + c];
  }
}

template <class S> void mlp_write_input_grads(const MlpFrame<S>& f, int64_t begin, const MlpBlock<S>& block) {
  const int stride = f.layer[0].input_stride;
  const S* first = block.v_x;
  for (int k = 0; k < f.v_x.count; first += f.v_x.of[k++].width) {
    const MlpTable<S>& table = f.v_x.of[k];
    S* to = table.data + begin * table.row;
    for (int i = 0; i < block.points; ++i, to += table.row)
      for (int c = 0; c < table.width; ++c) to[c * table.column] = first[i * stride + c];
  }
}

template <class S> void mlp_inputs_vjp(const MlpFrame<S>& f, int64_t begin, const MlpBlock<S>& block, const S* g) {
  using vf = typename Simd<S>::vf;
  const MlpLayer<S>& layer = f.layer[0];
  const int stride = layer.input_stride;
  product<S, 8, 1>(
      block.rows, stride, kHidden, Operand<S>{g, kHidden, 1}, layer.weights, stride, [](int, int) { return vf{}; },
      [&](int row, int column, vf y) { store(block.v_x + row * stride + column, y); });
  mlp_write_input_grads(f, begin, block);
}

template <class S>
void mlp_backward(const MlpFrame<S>& f, int64_t begin, int64_t end, S* scratch, const MlpGrads<S>& grads) {
  using vf = typename Simd<S>::vf;
  for (; begin < end; begin += kMlpBlock) {
    const MlpBlock<S> block(begin, end, scratch);
    mlp_hidden(f, begin, block);
    mlp_end_vjp(f, begin, block);
    const S* g = block.out;
    for (int l = f.shape.hidden_layers; l > 0; --l) {
      const MlpLayer<S>& layer = f.layer[l];
      const S* in = block.hidden[l - 1];
      mlp_weights_vjp<S, kWide>(layer, block.rows, g, in, grads.weights[l], grads.bias[l]);
      S* g_in = block.grad[l & 1];
      product<S, 4, kWide>(
          block.rows, kHidden, layer.outputs, Operand<S>{g, layer.outputs, 1}, layer.weights, kHidden,
          [](int, int) { return vf{}; },
          [&](int row, int column, vf y) {
            store(g_in + row * kHidden + column, load(in + row * kHidden + column) > 0 ? y : vf{});
          });
      g = g_in;
    }
    mlp_weights_vjp<S, 1>(f.layer[0], block.rows, g, block.x, grads.weights[0], grads.bias[0]);
    if (f.v_x.count) mlp_inputs_vjp(f, begin, block, g);
  }
}

template <class S> constexpr MlpKernels<S> mlp_kernels() { return {mlp_forward<S>, mlp_backward<S>}; }
