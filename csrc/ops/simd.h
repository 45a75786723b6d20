// Vectors of LANES scalars in GCC/Clang vector extensions. Included inside the namespace of one
// instruction set, so nothing here may be a weak std:: symbol. LANES must be the set's width.
template <class S> struct Simd;
template <> struct Simd<float> {
  typedef float vf __attribute__((vector_size(LANES * 4)));
  typedef int32_t vi __attribute__((vector_size(LANES * 4)));
#if defined(__AVX512F__) && LANES == 16
  struct vm {
    __mmask16 m;
  };
#else
  using vm = vi;
#endif
};
template <> struct Simd<double> {
  typedef double vf __attribute__((vector_size(LANES * 8)));
  typedef int64_t vi __attribute__((vector_size(LANES * 8)));
  using vm = vi;
};
using vf32 = Simd<float>::vf;
using vi32 = Simd<float>::vi;

template <class S> inline typename Simd<S>::vf load(const S* p) {
  typename Simd<S>::vf v;
  __builtin_memcpy(&v, p, sizeof v);
  return v;
}
template <class S> inline void store(S* p, typename Simd<S>::vf v) { __builtin_memcpy(p, &v, sizeof v); }
template <class S> inline typename Simd<S>::vf all(S x) { return typename Simd<S>::vf{} + x; }

template <class I> inline bool any_lane(I m) {
  bool hit = false;
  for (int i = 0; i < LANES; ++i) hit |= m[i] != 0;
  return hit;
}
// Comparisons give a vm, a set of lanes: a mask register where there are such, else vectors of -1 and 0.
template <class V> inline auto less(V a, V b) { return a < b; }
template <class V> inline auto at_most(V a, V b) { return a <= b; }
template <class M, class V> inline V select(M m, V a, V b) { return m ? a : b; }
template <class M, class V> inline V keep(M m, V a) { return m ? a : V{}; }  // 0 elsewhere
template <class M> inline uint64_t bits_of(M m) {
  uint64_t bits = 0;
  for (int i = 0; i < LANES; ++i) bits |= uint64_t(m[i] & 1) << i;
  return bits;
}
template <class V> inline V min_of(V a, V b) { return a < b ? a : b; }
template <class V> inline V max_of(V a, V b) { return a > b ? a : b; }
template <class V> inline V reciprocal(V x) { return 1 / x; }
template <class V> inline V abs_of(V x) { return x < 0 ? -x : x; }
inline Simd<double>::vf sqrt_of(Simd<double>::vf x) {
  for (int i = 0; i < LANES; ++i) x[i] = __builtin_sqrt(x[i]);
  return x;
}

#if defined(__AVX512F__) && LANES == 16
using vm32 = Simd<float>::vm;
inline vm32 operator&(vm32 a, vm32 b) { return {__mmask16(a.m & b.m)}; }
inline vm32 operator|(vm32 a, vm32 b) { return {__mmask16(a.m | b.m)}; }
inline vm32 operator~(vm32 a) { return {__mmask16(~a.m)}; }
inline bool any_lane(vm32 m) { return m.m != 0; }
inline uint64_t bits_of(vm32 m) { return m.m; }
inline vm32 less(vf32 a, vf32 b) { return {_mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_LT_OQ)}; }
inline vm32 at_most(vf32 a, vf32 b) { return {_mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_LE_OQ)}; }
inline vf32 select(vm32 m, vf32 a, vf32 b) { return (vf32)_mm512_mask_blend_ps(m.m, (__m512)b, (__m512)a); }
inline vf32 keep(vm32 m, vf32 a) { return (vf32)_mm512_maskz_mov_ps(m.m, (__m512)a); }
inline bool any_lane(vi32 m) { return _mm512_test_epi32_mask((__m512i)m, (__m512i)m) != 0; }
inline vf32 min_of(vf32 a, vf32 b) { return (vf32)_mm512_min_ps((__m512)a, (__m512)b); }
inline vf32 max_of(vf32 a, vf32 b) { return (vf32)_mm512_max_ps((__m512)a, (__m512)b); }
inline vf32 reciprocal(vf32 x) {
  const __m512 r = _mm512_rcp14_ps((__m512)x);
  return (vf32)_mm512_mul_ps(r, _mm512_fnmadd_ps((__m512)x, r, _mm512_set1_ps(2.f)));
}
inline vf32 abs_of(vf32 x) { return (vf32)_mm512_abs_ps((__m512)x); }
inline vf32 sqrt_of(vf32 x) { return (vf32)_mm512_sqrt_ps((__m512)x); }
#elif defined(__AVX2__) && LANES == 8
inline uint64_t bits_of(vi32 m) { return uint32_t(_mm256_movemask_ps((__m256)m)); }
inline bool any_lane(vi32 m) { return !_mm256_testz_si256((__m256i)m, (__m256i)m); }
inline vf32 min_of(vf32 a, vf32 b) { return (vf32)_mm256_min_ps((__m256)a, (__m256)b); }
inline vf32 max_of(vf32 a, vf32 b) { return (vf32)_mm256_max_ps((__m256)a, (__m256)b); }
inline vf32 reciprocal(vf32 x) {
  const __m256 r = _mm256_rcp_ps((__m256)x);
  return (vf32)_mm256_mul_ps(r, _mm256_fnmadd_ps((__m256)x, r, _mm256_set1_ps(2.f)));
}
inline vf32 sqrt_of(vf32 x) { return (vf32)_mm256_sqrt_ps((__m256)x); }
#else
inline vf32 sqrt_of(vf32 x) {
  for (int i = 0; i < LANES; ++i) x[i] = __builtin_sqrtf(x[i]);
  return x;
}
#endif

// e^x for x <= 0, to 1e-7 of it; from e^-86 on, a number too small to matter.
inline vf32 exp_of(vf32 x) {
  const vf32 t = max_of(x * 1.44269504f, all(-124.f));
#if defined(__AVX512F__) && LANES == 16
  const vf32 i = (vf32)_mm512_roundscale_ps((__m512)t, 0), f = t - i;
#else
  const vi32 i = __builtin_convertvector(t - 0.5f, vi32);
  const vf32 f = t - __builtin_convertvector(i, vf32);
#endif
  const vf32 low = 6.931469671e-1f * f + 1.000000072f, middle = 5.550713274e-2f * f + 2.402211972e-1f;
  const vf32 high = 1.327647206e-3f * f + 9.675541407e-3f, f2 = f * f;  // by pairs: a shorter chain
  const vf32 p = (high * f2 + middle) * f2 + low;
#if defined(__AVX512F__) && LANES == 16
  return (vf32)_mm512_scalef_ps((__m512)p, (__m512)i);
#else
  return p * (vf32)((i + 127) << 23);
#endif
}
inline Simd<double>::vf exp_of(Simd<double>::vf x) {
  Simd<double>::vf r;
  for (int i = 0; i < LANES; ++i) r[i] = __builtin_exp(x[i]);
  return r;
}

// The lane sums of n vectors.
template <class S> inline void lane_sums(const typename Simd<S>::vf* v, int n, S* out) {
  for (int k = 0; k < n; ++k) {
    S s = 0;
    for (int i = 0; i < LANES; ++i) s += v[k][i];
    out[k] = s;
  }
}
#if defined(__AVX512F__) && LANES == 16
// Sixteen at a time by one transposed reduction, then eight; v must be readable up to a multiple of 16.
inline __m512 lane_sums_16(const vf32* v) {
  __m512 t[8], q[4];
  for (int i = 0; i < 8; ++i)
    t[i] = _mm512_add_ps(_mm512_unpacklo_ps((__m512)v[2 * i], (__m512)v[2 * i + 1]),
                         _mm512_unpackhi_ps((__m512)v[2 * i], (__m512)v[2 * i + 1]));
  for (int i = 0; i < 4; ++i) {
    const __m512d a = _mm512_castps_pd(t[2 * i]), b = _mm512_castps_pd(t[2 * i + 1]);
    q[i] = _mm512_add_ps(_mm512_castpd_ps(_mm512_unpacklo_pd(a, b)), _mm512_castpd_ps(_mm512_unpackhi_pd(a, b)));
  }
  const __m512 a = _mm512_add_ps(_mm512_shuffle_f32x4(q[0], q[1], 0x88), _mm512_shuffle_f32x4(q[0], q[1], 0xdd));
  const __m512 b = _mm512_add_ps(_mm512_shuffle_f32x4(q[2], q[3], 0x88), _mm512_shuffle_f32x4(q[2], q[3], 0xdd));
  return _mm512_add_ps(_mm512_shuffle_f32x4(a, b, 0x88), _mm512_shuffle_f32x4(a, b, 0xdd));
}
inline __m256 lane_sums_8(const vf32* v) {
  __m512 t[4], q[2];
  for (int i = 0; i < 4; ++i)
    t[i] = _mm512_add_ps(_mm512_unpacklo_ps((__m512)v[2 * i], (__m512)v[2 * i + 1]),
                         _mm512_unpackhi_ps((__m512)v[2 * i], (__m512)v[2 * i + 1]));
  for (int i = 0; i < 2; ++i) {
    const __m512d a = _mm512_castps_pd(t[2 * i]), b = _mm512_castps_pd(t[2 * i + 1]);
    q[i] = _mm512_add_ps(_mm512_castpd_ps(_mm512_unpacklo_pd(a, b)), _mm512_castpd_ps(_mm512_unpackhi_pd(a, b)));
  }
  const __m512 s = _mm512_add_ps(_mm512_shuffle_f32x4(q[0], q[1], 0x88), _mm512_shuffle_f32x4(q[0], q[1], 0xdd));
  const __m256 first = _mm512_castps512_ps256(s), second = _mm512_extractf32x8_ps(s, 1);
  return _mm256_add_ps(_mm256_permute2f128_ps(first, second, 0x20), _mm256_permute2f128_ps(first, second, 0x31));
}
inline void lane_sums(const vf32* v, int n, float* out) {
  int k = 0;
  for (; n - k > 8; k += 16) {
    const int left = n - k < 16 ? n - k : 16;
    _mm512_mask_storeu_ps(out + k, (__mmask16)((1u << left) - 1), lane_sums_16(v + k));
  }
  if (k < n) _mm256_mask_storeu_ps(out + k, (__mmask8)((1u << (n - k)) - 1), lane_sums_8(v + k));
}
#elif defined(__AVX2__) && LANES == 8
inline void lane_sums(const vf32* v, int n, float* out) {
  for (int k = 0; k < n; k += 4) {
    const __m256 a = _mm256_hadd_ps(_mm256_hadd_ps((__m256)v[k], (__m256)v[k + 1]),
                                    _mm256_hadd_ps((__m256)v[k + 2], (__m256)v[k + 3]));
    const __m128 s = _mm_add_ps(_mm256_castps256_ps128(a), _mm256_extractf128_ps(a, 1));
    float four[4];
    _mm_storeu_ps(four, s);
    for (int i = 0; i < 4 && k + i < n; ++i) out[k + i] = four[i];
  }
}
#endif
