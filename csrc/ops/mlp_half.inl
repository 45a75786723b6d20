// The network with products of bfloat16 numbers and float sums, by AVX512-BF16. One instruction takes two
// steps of a sum, so its operands come in pairs along it: hidden values and gradients lie point by point
// (rows: 32 pairs of channels) for products towards outputs or inputs, and as pairs of points (pairs) for
// the weights' gradients. The first layer forward and the last stay in float.

inline __m512bh half_load(const uint32_t* p) { return (__m512bh)_mm512_loadu_si512(p); }
inline __m512bh half_all(uint32_t pair) { return (__m512bh)_mm512_set1_epi32(int(pair)); }
inline __m512i half_of(vf32 low, vf32 high) { return (__m512i)_mm512_cvtne2ps_pbh((__m512)high, (__m512)low); }
inline vf32 half_dot(vf32 sum, __m512bh a, __m512bh b) { return (vf32)_mm512_dpbf16_ps((__m512)sum, a, b); }

// For permuting (top, bottom): 16 numbers from `first` on, each followed by the one `apart` further.
inline __m512i half_order(int first, int apart) {
  alignas(64) uint16_t order[32];
  for (int i = 0; i < 16; ++i) order[2 * i] = uint16_t(first + i), order[2 * i + 1] = uint16_t(first + i + apart);
  return _mm512_load_si512(order);
}

// Pairs of two rows' numbers, column by column.
inline void half_interleave(__m512i top, __m512i bottom, int columns, uint32_t* pairs) {
  _mm512_storeu_si512(pairs, _mm512_permutex2var_epi16(top, half_order(0, 32), bottom));
  if (columns > 16) _mm512_storeu_si512(pairs + 16, _mm512_permutex2var_epi16(top, half_order(16, 32), bottom));
}

// Rows of floats as pairs of rows: out[row / 2][column].
inline void half_pack(const float* from, int rows, int columns, uint32_t* out) {
  for (int row = 0; row < rows; row += 2)
    for (int c = 0; c < columns; c += 32) {
      const auto line = [&](int r) {
        const float* p = from + r * columns + c;
        return half_of(load(p), columns - c > 16 ? load(p + 16) : vf32{});
      };
      half_interleave(line(row), line(row + 1), columns - c, out + row / 2 * columns + c);
    }
}
// The same of rows that are bfloat16 already.
inline void half_pair_rows(const uint32_t* from, int rows, uint32_t* out) {
  for (int row = 0; row < rows; row += 2)
    for (int h = 0; h < 2; ++h) {
      const uint32_t* p = from + row * 32 + 16 * h;
      half_interleave(_mm512_loadu_si512(p), _mm512_loadu_si512(p + 32), 32, out + row * 32 + 32 * h);
    }
}

// finish(row, sums) of R rows from `row` on: start(row, v) + sum over k of a(row, k) . b(k, v), k over pairs.
template <int R, int V, class Start, class Finish>
inline __attribute__((always_inline)) void half_product(int rows, int depth, Operand<uint32_t> a, const uint32_t* b,
                                                        Start start, Finish finish) {
  for (int row = 0; row < rows; row += R) {
    vf32 sum[R][V];
    for (int r = 0; r < R; ++r)
      for (int v = 0; v < V; ++v) sum[r][v] = start(row + r, v);
    const uint32_t *pa = a.data + row * a.row, *pb = b;
    for (int k = 0; k < depth; ++k, pa += a.step, pb += V * 16) {
      __m512bh vb[V];
      for (int v = 0; v < V; ++v) vb[v] = half_load(pb + v * 16);
      for (int r = 0; r < R; ++r) {
        const __m512bh x = half_all(pa[r * a.row]);
        for (int v = 0; v < V; ++v) sum[r][v] = half_dot(sum[r][v], x, vb[v]);
      }
    }
    finish(row, sum);
  }
}

struct HalfBlock {
  MlpBlock<float> exact;  // its x, out and v_x
  uint32_t *rows[kMlpHiddenLayers], *pairs[kMlpHiddenLayers];               // hidden values
  uint32_t *to_outputs[kMlpHiddenLayers], *to_inputs[kMlpHiddenLayers];     // weights, in pairs along the sum
  uint32_t *g_rows[2], *g_pairs, *x_pairs;

  HalfBlock(const MlpFrame<float>& f, int64_t begin, int64_t end, float* scratch) : exact(begin, end, scratch) {
    uint32_t* next = reinterpret_cast<uint32_t*>(scratch + kMlpScratch);
    const auto take = [&](uint32_t*& part) { part = next, next += kMlpPairs; };
    for (int l = 0; l < kMlpHiddenLayers; ++l) take(rows[l]), take(pairs[l]), take(to_outputs[l]), take(to_inputs[l]);
    take(g_rows[0]), take(g_rows[1]), take(g_pairs), take(x_pairs);
    for (int l = 0; f.kept && l < f.shape.hidden_layers; ++l)
      rows[l] = f.kept + (begin / kMlpBlock * f.shape.hidden_layers + l) * kMlpPairs;
  }
};

inline void half_hidden(const MlpFrame<float>& f, int64_t begin, const HalfBlock& block, bool to_the_end) {
  const int rows = block.exact.rows, layers = f.shape.hidden_layers;
  const MlpLayer<float>&first = f.layer[0], &last = f.layer[layers];
  const auto finish = [&](int l, int row, vf32 (*y)[4]) {
    for (int r = 0; r < 4; ++r) {
      for (int v = 0; v < 4; ++v) y[r][v] = max_of(vf32{}, y[r][v]);
      for (int h = 0; h < 2; ++h)
        _mm512_storeu_si512(block.rows[l] + (row + r) * 32 + 16 * h, half_of(y[r][2 * h], y[r][2 * h + 1]));
    }
    if (!to_the_end || l < layers - 1) return;
    vf32 sums[4 * kMlpOutputs] = {};
    for (int c = 0; c < kMlpOutputs; ++c)
      for (int v = 0; v < 4; ++v) {
        const vf32 weights = load(last.weights + c * last.input_stride + 16 * v);
        for (int r = 0; r < 4; ++r) sums[r * kMlpOutputs + c] += y[r][v] * weights;
      }
    alignas(64) float flat[4 * kMlpOutputs];
    lane_sums(sums, 4 * kMlpOutputs, flat);
    for (int r = 0; r < 4; ++r)
      for (int c = 0; c < kMlpOutputs; ++c)
        block.exact.out[(row + r) * kMlpColumns + c] = flat[r * kMlpOutputs + c] + last.bias[c];
  };
  mlp_read_inputs(f, begin, block.exact);
  for (int row = 0; row < rows; row += 4) {
    vf32 y[4][4];
    for (int r = 0; r < 4; ++r)
      for (int v = 0; v < 4; ++v) y[r][v] = load(first.bias + 16 * v);
    for (int k = 0; k < first.inputs; ++k)
      for (int r = 0; r < 4; ++r) {
        const float x = block.exact.x[(row + r) * first.input_stride + k];
        for (int v = 0; v < 4; ++v) y[r][v] += x * load(first.transposed + k * first.stride + 16 * v);
      }
    finish(0, row, y);
  }
  for (int l = 1; l < layers; ++l)
    half_product<4, 4>(
        rows, kHidden / 2, {block.rows[l - 1], 32, 1}, block.to_outputs[l],
        [&](int, int v) { return load(f.layer[l].bias + 16 * v); }, [&](int row, vf32(*y)[4]) { finish(l, row, y); });
}

inline void half_pack_forward(const MlpFrame<float>& f, const HalfBlock& block) {
  for (int l = 1; l < f.shape.hidden_layers; ++l) half_pack(f.layer[l].transposed, kHidden, kHidden, block.to_outputs[l]);
}

void half_forward(const MlpFrame<float>& f, int64_t begin, int64_t end, float* scratch) {
  half_pack_forward(f, HalfBlock(f, begin, end, scratch));
  for (; begin < end; begin += kMlpBlock) {
    const HalfBlock block(f, begin, end, scratch);
    half_hidden(f, begin, block, true);
    mlp_write_outputs(f, begin, block.exact);
  }
}

// Where the hidden value is positive, its gradient; `in` and `out`: a row.
inline void half_store_relu_vjp(const uint32_t* in, const vf32* g, uint32_t* out) {
  for (int h = 0; h < 2; ++h) {
    const __mmask32 positive = _mm512_cmpgt_epi16_mask(_mm512_loadu_si512(in + 16 * h), _mm512_setzero_si512());
    _mm512_storeu_si512(out + 16 * h, _mm512_maskz_mov_epi16(positive, half_of(g[2 * h], g[2 * h + 1])));
  }
}

// Adds a block's share of a layer's gradient; g, in: pairs of points.
template <int R, int V>
void half_weights_vjp(int outputs, int rows, const uint32_t* g, const uint32_t* in, float* v_weights) {
  half_product<R, V>(
      outputs, rows / 2, {g, 1, outputs}, in,
      [&](int row, int v) { return load(v_weights + (row * V + v) * 16); },
      [&](int row, vf32(*y)[V]) {
        for (int i = 0; i < R * V; ++i) store(v_weights + (row * V + i) * 16, y[i / V][i % V]);
      });
}
inline void half_bias_vjp(int rows, const uint32_t* g_pairs, float* v_bias) {
  vf32 sum[4];
  for (int v = 0; v < 4; ++v) sum[v] = load(v_bias + 16 * v);
  for (int k = 0; k < rows / 2; ++k)
    for (int v = 0; v < 4; ++v)
      sum[v] = half_dot(sum[v], half_load(g_pairs + k * kHidden + 16 * v), half_all(0x3f803f80));  // twice 1
  for (int v = 0; v < 4; ++v) store(v_bias + 16 * v, sum[v]);
}

// The last layer, in float but for its weights' gradient; gives the gradient by the hidden values' row.
inline void half_last_vjp(const MlpFrame<float>& f, const HalfBlock& block, const MlpGrads<float>& grads) {
  const int top = f.shape.hidden_layers, rows = block.exact.rows;
  const MlpLayer<float>& last = f.layer[top];
  alignas(64) uint32_t pairs[kMlpBlock / 2 * kMlpOutputs];
  for (int row = 0; row < rows; ++row) {
    const float* g = block.exact.out + row * kMlpOutputs;
    vf32 y[4] = {};
    for (int c = 0; c < kMlpOutputs; ++c) {
      grads.bias[top][c] += g[c];
      for (int v = 0; v < 4; ++v) y[v] += g[c] * load(last.weights + c * last.input_stride + 16 * v);
    }
    half_store_relu_vjp(block.rows[top - 1] + row * 32, y, block.g_rows[top & 1] + row * 32);
  }
  alignas(64) uint16_t order[32];
  for (int i = 0; i < 32; ++i) order[i] = uint16_t(i / 8 * 8 + i % 2 * 4 + i % 8 / 2);
  for (int row = 0; row < rows; row += 8) {
    const float* g = block.exact.out + row * kMlpOutputs;
    const __m512i eight = half_of(load(g), load(g + 16));
    _mm512_store_si512(pairs + row / 2 * kMlpOutputs, _mm512_permutexvar_epi16(_mm512_load_si512(order), eight));
  }
  half_weights_vjp<kMlpOutputs, 4>(kMlpOutputs, rows, pairs, block.pairs[top - 1], grads.weights[top]);
}

template <int V>
void half_first_vjp(const MlpFrame<float>& f, int64_t begin, const HalfBlock& block, const uint32_t* g_rows,
                    float* v_weights) {
  const int rows = block.exact.rows;
  half_pack(block.exact.x, rows, V * 16, block.x_pairs);
  half_weights_vjp<8, V>(kHidden, rows, block.g_pairs, block.x_pairs, v_weights);
  if (!f.v_x.count) return;
  half_product<8, V>(
      rows, kHidden / 2, {g_rows, 32, 1}, block.to_inputs[0], [](int, int) { return vf32{}; },
      [&](int row, vf32(*y)[V]) {
        for (int i = 0; i < 8 * V; ++i) store(block.exact.v_x + (row * V + i) * 16, y[i / V][i % V]);
      });
  mlp_write_input_grads(f, begin, block.exact);
}

void half_backward(const MlpFrame<float>& f, int64_t begin, int64_t end, float* scratch,
                   const MlpGrads<float>& grads) {
  const int top = f.shape.hidden_layers;
  const HalfBlock any(f, begin, end, scratch);
  if (!f.kept) half_pack_forward(f, any);
  for (int l = 0; l < top; ++l) half_pack(f.layer[l].weights, kHidden, f.layer[l].input_stride, any.to_inputs[l]);
  for (; begin < end; begin += kMlpBlock) {
    const HalfBlock block(f, begin, end, scratch);
    const int rows = block.exact.rows;
    if (f.kept)
      mlp_read_inputs(f, begin, block.exact);
    else
      half_hidden(f, begin, block, false);
    for (int l = 0; l < top; ++l) half_pair_rows(block.rows[l], rows, block.pairs[l]);
    mlp_end_vjp(f, begin, block.exact);
    half_last_vjp(f, block, grads);
    for (int l = top - 1;; --l) {
      const uint32_t* g = block.g_rows[(l + 1) & 1];
      half_pair_rows(g, rows, block.g_pairs);
      half_bias_vjp(rows, block.g_pairs, grads.bias[l]);
      if (l == 0) {
        const auto first = f.layer[0].input_stride == 16 ? half_first_vjp<1> : half_first_vjp<2>;
        first(f, begin, block, g, grads.weights[0]);
        break;
      }
      half_weights_vjp<4, 4>(kHidden, rows, block.g_pairs, block.pairs[l - 1], grads.weights[l]);
      half_product<4, 4>(
          rows, kHidden / 2, {g, 32, 1}, block.to_inputs[l], [](int, int) { return vf32{}; },
          [&](int row, vf32(*y)[4]) {
            for (int r = 0; r < 4; ++r)
              half_store_relu_vjp(block.rows[l - 1] + (row + r) * 32, y[r], block.g_rows[l & 1] + (row + r) * 32);
          });
    }
  }
}
