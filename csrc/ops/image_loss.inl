// One call does one channel of one band of rows. Rows stream through rings of 11: the two images' rows are
// blurred down then across (x, y, xx, yy, xy), SSIM and its derivatives by (mean of x, of xx, of xy) follow
// per pixel, and those three are blurred again, which is the adjoint of the blur (the window is symmetric
// and the outside is zero). Nothing larger than some rows is ever stored; a band recomputes 5 rows of
// derivatives on either side, so that bands do not depend on each other.

template <class S> struct LossRows {
  int64_t stride;
  S *x, *y;       // rings of kLossTaps rows
  S* slopes;      // three rings: dSSIM/d mean(x), d mean(xx), d mean(xy), times the pixel's weight
  S* blurred;     // five rows, blurred downwards
  S *zero, *weight, *line;

  LossRows(int width, S* scratch) : stride(loss_row(width)) {
    x = scratch + kLossPad;
    y = x + kLossTaps * stride;
    slopes = y + kLossTaps * stride;
    blurred = slopes + 3 * kLossTaps * stride;
    zero = blurred + 5 * stride;
    weight = zero + stride;
    line = weight + stride;
  }
  S* at(S* ring, int row) const { return ring + (row + 2 * kLossTaps) % kLossTaps * stride; }
};

template <class S> void loss_read_row(const Image<S>& image, int channel, int row, int width, S* out) {
  const S* p = image.data + channel * image.channel + row * image.row;
  if (image.column == 1) {
    __builtin_memcpy(out, p, size_t(width) * sizeof(S));
    return;
  }
  for (int i = 0; i < width; ++i) out[i] = p[i * image.column];
}

template <class S> void loss_read_weight(const LossFrame<S>& f, int row, S* out) {
  for (int i = 0; i < f.width; ++i) out[i] = f.weight ? f.weight[int64_t(row) * f.width + i] : S(1);
}

// Rows of x and y around one row, blurred downwards.
template <class S> void loss_blur_pairs(const LossFrame<S>& f, const LossRows<S>& rows, int row) {
  using vf = typename Simd<S>::vf;
  const S *px[kLossTaps], *py[kLossTaps];
  for (int k = 0; k < kLossTaps; ++k) {
    const int r = row + k - kLossReach;
    const bool inside = r >= 0 && r < f.height;
    px[k] = inside ? rows.at(rows.x, r) : rows.zero;
    py[k] = inside ? rows.at(rows.y, r) : rows.zero;
  }
  for (int i = 0; i < f.width; i += LANES) {
    vf mx{}, my{}, xx{}, yy{}, xy{};
    for (int k = 0; k < kLossTaps; ++k) {
      const vf x = load(px[k] + i), y = load(py[k] + i), wx = f.taps[k] * x, wy = f.taps[k] * y;
      mx += wx;
      my += wy;
      xx += wx * x;
      yy += wy * y;
      xy += wx * y;
    }
    const vf sums[5] = {mx, my, xx, yy, xy};
    for (int q = 0; q < 5; ++q) store(rows.blurred + q * rows.stride + i, sums[q]);
  }
}

template <class S> inline typename Simd<S>::vf loss_blur_across(const LossFrame<S>& f, const S* row) {
  typename Simd<S>::vf sum{};
  for (int k = 0; k < kLossTaps; ++k) sum += f.taps[k] * load(row + k - kLossReach);
  return sum;
}

// SSIM of one row from its blurred moments; leaves its derivatives in the rings. Returns the weighted sum.
template <class S>
typename Simd<S>::vf loss_compare(const LossFrame<S>& f, const LossRows<S>& rows, int row, S* map) {
  using vf = typename Simd<S>::vf;
  const S c1 = S(1e-4), c2 = S(9e-4);
  S* slopes[3];
  for (int q = 0; q < 3; ++q) slopes[q] = rows.at(rows.slopes + q * kLossTaps * rows.stride, row);
  vf total{};
  for (int i = 0; i < f.width; i += LANES) {
    vf m[5];
    for (int q = 0; q < 5; ++q) m[q] = loss_blur_across(f, rows.blurred + q * rows.stride + i);
    const vf mx = m[0], my = m[1], w = load(rows.weight + i);
    const vf means = mx * mx + my * my;
    const vf a1 = 2 * mx * my + c1, a2 = 2 * (m[4] - mx * my) + c2;
    const vf ib1 = reciprocal(means + c1), ib2 = reciprocal(max_of(m[2] + m[3] - means, vf{}) + c2);
    const vf s = a1 * a2 * ib1 * ib2;
    const vf by_xx = -s * ib2, by_xy = 2 * a1 * ib1 * ib2;
    const vf by_mx = 2 * (my * a2 * ib1 * ib2 - mx * s * ib1 - mx * by_xx) - my * by_xy;
    total += w * s;
    store(slopes[0] + i, w * by_mx);
    store(slopes[1] + i, w * by_xx);
    store(slopes[2] + i, w * by_xy);
    if (map) store(map + i, s);
  }
  return total;
}

template <class S> double loss_lanes(typename Simd<S>::vf v) {
  double sum = 0;
  for (int i = 0; i < LANES; ++i) sum += double(v[i]);
  return sum;
}

// The gradient of one row; adds the row's sums of |x - y| and (x - y)^2.
template <class S>
void loss_finish_row(const LossFrame<S>& f, const LossRows<S>& rows, int row, double* sums) {
  using vf = typename Simd<S>::vf;
  const S *x = rows.at(rows.x, row), *y = rows.at(rows.y, row);
  vf absolute{}, squared{};
  for (int i = 0; i < f.width; i += LANES) {
    const vf d = load(x + i) - load(y + i), w = load(rows.weight + i);
    absolute += w * abs_of(d);
    squared += w * d * d;
  }
  sums[0] += loss_lanes<S>(absolute);
  sums[2] += loss_lanes<S>(squared);
  if (!f.gradient) return;
  for (int q = 0; q < 3; ++q) {
    const S* ring = rows.slopes + q * kLossTaps * rows.stride;
    const S* p[kLossTaps];
    for (int k = 0; k < kLossTaps; ++k) {
      const int r = row + k - kLossReach;
      p[k] = r >= 0 && r < f.height ? rows.at(const_cast<S*>(ring), r) : rows.zero;
    }
    for (int i = 0; i < f.width; i += LANES) {
      vf sum{};
      for (int k = 0; k < kLossTaps; ++k) sum += f.taps[k] * load(p[k] + i);
      store(rows.blurred + q * rows.stride + i, sum);
    }
  }
  for (int i = 0; i < f.width; i += LANES) {
    vf g[3];
    for (int q = 0; q < 3; ++q) g[q] = loss_blur_across(f, rows.blurred + q * rows.stride + i);
    const vf vx = load(x + i), vy = load(y + i), d = vx - vy, w = load(rows.weight + i);
    const vf sign = d > 0 ? all(S(1)) : d < 0 ? all(S(-1)) : vf{};
    store(rows.line + i, f.l1_scale * (w * sign) + f.ssim_scale * (g[0] + 2 * vx * g[1] + vy * g[2]));
  }
}

template <class S> void loss_band(const LossFrame<S>& f, int channel, int band, S* scratch, double* sums) {
  const LossRows<S> rows(f.width, scratch);
  const int begin = band * kLossBand, end = begin + kLossBand < f.height ? begin + kLossBand : f.height;
  const int around = f.gradient ? kLossReach : 0;
  const int64_t plane = int64_t(channel) * f.height;
  const size_t bytes = size_t(f.width) * sizeof(S);
  for (int row = begin - around - 2 * kLossReach; row < end + around; ++row) {
    const int next = row + kLossReach;
    if (next >= 0 && next < f.height) {
      loss_read_row(f.image, channel, next, f.width, rows.at(rows.x, next));
      loss_read_row(f.target, channel, next, f.width, rows.at(rows.y, next));
    }
    if (row < begin - around) continue;
    if (row >= 0 && row < f.height) {
      loss_read_weight(f, row, rows.weight);
      loss_blur_pairs(f, rows, row);
      const bool ours = row >= begin && row < end;
      const double ssim = loss_lanes<S>(loss_compare(f, rows, row, f.map && ours ? rows.line : nullptr));
      if (ours) sums[1] += ssim;
      if (f.map && ours) __builtin_memcpy(f.map + (plane + row) * f.width, rows.line, bytes);
    }
    const int done = row - around;
    if (done < begin) continue;
    loss_read_weight(f, done, rows.weight);
    loss_finish_row(f, rows, done, sums);
    if (f.gradient) __builtin_memcpy(f.gradient + (plane + done) * f.width, rows.line, bytes);
  }
}
