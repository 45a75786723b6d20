// LANES pixels at a time; bytes become numbers on the way.

// LANES of `left` bytes, the rest zero, as 0..1.
template <class S> inline typename Simd<S>::vf unit_bytes(const uint8_t* p, int64_t left) {
  typedef uint8_t bytes __attribute__((vector_size(LANES)));
  bytes b{};
  if (left >= LANES)
    __builtin_memcpy(&b, p, LANES);
  else
    __builtin_memcpy(&b, p, size_t(left));
  return __builtin_convertvector(b, typename Simd<S>::vf) * S(1.0 / 255);
}

template <class S>
void photo_composited(const Photo& photo, const S* backdrop, int64_t first, int64_t last, S* out) {
  using vf = typename Simd<S>::vf;
  const int64_t plane = int64_t(photo.width) * photo.height;
  for (int64_t i = first; i < last; i += LANES) {
    const int64_t left = last - i;
    const vf m = photo.mask ? unit_bytes<S>(photo.mask + i, left) : all(S(1)), around = 1 - m;
    for (int c = 0; c < 3; ++c) {
      const vf color = unit_bytes<S>(photo.rgb + c * plane + i, left) * m + around * backdrop[c];
      write_along(out + c * plane + first, int(i - first), int(last - first), color);
    }
  }
}

template <class S> double photo_mask_entropy(const MaskEntropy<S>& in, int64_t first, int64_t last) {
  using vf = typename Simd<S>::vf;
  const vf low = all(S(1e-4)), high = all(S(1) - S(1e-4));
  double sum = 0;
  for (int64_t y = first; y < last; ++y) {
    vf row{};
    for (int x = 0; x < in.width; x += LANES) {
      const vf m = unit_bytes<S>(in.mask + y * in.width + x, in.width - x), alpha = along(in.alpha, y, x, in.width, 0);
      const vf a = min_of(high, max_of(low, alpha)), b = 1 - a;  // in this order a NaN stays one
      vf term = -(m * ln_of(a) + (1 - m) * ln_of(b));
      term = a == a ? term : a;
      if (in.width - x < LANES)
        for (int i = in.width - x; i < LANES; ++i) term[i] = 0;
      row += term;
      if (!in.v_alpha) continue;
      const auto inside = at_most(low, alpha) & at_most(alpha, high);
      const vf slope = in.scale * (b * m - a * (1 - m)) * reciprocal(a * b);
      write_along(in.v_alpha + y * in.width, x, in.width, keep(inside, -slope));
    }
    for (int i = 0; i < LANES; ++i) sum += double(row[i]);
  }
  return sum;
}

template <class S> constexpr PhotoKernels<S> photo_kernels() { return {photo_composited<S>, photo_mask_entropy<S>}; }
