// LANES covered pixels at a time, or LANES pixels along a row. Covered pixels mostly lie side by side, where
// they are read and written as vectors; elsewhere one by one.

template <class S> using Value = typename Simd<S>::vf;

// Natural logarithm of positive numbers, polynomial of Cephes logf.
inline vf32 ln_of(vf32 x) {
  const vi32 bits = (vi32)x;
  vi32 exponent = (bits >> 23) - 127;
  vf32 m = (vf32)((bits & 0x7fffff) | 0x3f800000);
  const vi32 large = m > 1.41421356f;
  m = large ? m * 0.5f : m;
  exponent = large ? exponent + 1 : exponent;
  const vf32 t = m - 1, z = t * t, e = __builtin_convertvector(exponent, vf32);
  vf32 p = 7.0376836292e-2f * t - 1.1514610310e-1f;
  p = p * t + 1.1676998740e-1f;
  p = p * t - 1.2420140846e-1f;
  p = p * t + 1.4249322787e-1f;
  p = p * t - 1.6668057665e-1f;
  p = p * t + 2.0000714765e-1f;
  p = p * t - 2.4999993993e-1f;
  p = p * t + 3.3333331174e-1f;
  return e * 0.693359375f + (t + (p * t * z - 0.5f * z - e * 2.12194440e-4f));
}
inline Simd<double>::vf ln_of(Simd<double>::vf x) {
  for (int i = 0; i < LANES; ++i) x[i] = __builtin_log(x[i]);
  return x;
}

template <class V, class S> inline V power_of(V x, S exponent) { return exp_of(ln_of(x) * exponent); }

#include "../math/pixel.inl"

// LANES covered pixels from number `first` on; past the last one, the last again.
template <class S> struct Spots {
  using vi = typename Simd<S>::vi;
  int64_t first;
  int lanes;
  bool run;  // LANES pixels side by side
  vi x, y;

  Spots(const int64_t* pixels, int64_t from, int64_t end, int width)
      : first(from), lanes(end - from < LANES ? int(end - from) : LANES) {
    for (int i = 0; i < LANES; ++i) x[i] = int32_t(pixels[from + (i < lanes ? i : lanes - 1)]);
    using vf = typename Simd<S>::vf;
    y = __builtin_convertvector(__builtin_convertvector(x, vf) * S(1.0 / width), vi);  // one off at most
    x -= y * width;
    y = x < 0 ? y - 1 : x >= width ? y + 1 : y;
    x = x < 0 ? x + width : x >= width ? x - width : x;
    run = lanes == LANES && x[LANES - 1] - x[0] == LANES - 1 && y[LANES - 1] == y[0];
  }
};

template <class S> inline typename Simd<S>::vf gather(const Image<S>& image, const Spots<S>& at, int c) {
  const S* data = image.data + c * image.channel;
  if (at.run && image.column == 1) return load(data + at.y[0] * image.row + at.x[0]);
  alignas(64) S out[LANES];
  for (int i = 0; i < LANES; ++i) out[i] = data[at.y[i] * image.row + at.x[i] * image.column];
  return load(out);
}
template <class S> inline void scatter(S* plane, int width, const Spots<S>& at, typename Simd<S>::vf v) {
  if (at.run) return store(plane + int64_t(at.y[0]) * width + at.x[0], v);
  for (int i = 0; i < at.lanes; ++i) plane[int64_t(at.y[i]) * width + at.x[i]] = v[i];
}
template <class S> inline typename Simd<S>::vf pick(Rows<const S> rows, const Spots<S>& at, int c) {
  const S* data = rows.data + at.first * rows.row + c * rows.column;
  if (at.lanes == LANES && rows.row == 1) return load(data);
  alignas(64) S out[LANES];
  for (int i = 0; i < LANES; ++i) out[i] = data[(i < at.lanes ? i : at.lanes - 1) * rows.row];
  return load(out);
}
template <class S> inline void put(Rows<S> rows, const Spots<S>& at, int c, typename Simd<S>::vf v) {
  S* data = rows.data + at.first * rows.row + c * rows.column;
  if (at.lanes == LANES && rows.row == 1) return store(data, v);
  for (int i = 0; i < at.lanes; ++i) data[i * rows.row] = v[i];
}
template <class S> inline V3<S> pick3(Rows<const S> rows, const Spots<S>& at) {
  return {pick(rows, at, 0), pick(rows, at, 1), pick(rows, at, 2)};
}

template <class S> inline Mirror<S> mirror_at(const Covered<S>& in, const Spots<S>& at) {
  const View<S>& view = in.view;
  const V3<S> r{(__builtin_convertvector(at.x, Value<S>) + (S(0.5) - view.cx)) * (1 / view.fx),
                (__builtin_convertvector(at.y, Value<S>) + (S(0.5) - view.cy)) * (1 / view.fy), all(S(1))};
  return {rotate(view.world_from_cam, UnitVector<S>(r, S(0)).unit),
          {gather(in.normal, at, 0), gather(in.normal, at, 1), gather(in.normal, at, 2)}};
}

template <class S> void shade_inputs(const Covered<S>& in, Band band, const Inputs<S>& out) {
  using vf = typename Simd<S>::vf;
  for (int64_t i = band.begin; i < band.end; i += LANES) {
    const Spots<S> at(in.pixels, i, band.end, in.view.width);
    const vf whole = reciprocal(gather(in.alpha, at, 0));
    for (int c = 0; c < 3; ++c) put(out.diffuse, at, c, gather(in.features, at, c) * whole);
    put(out.roughness, at, 0, gather(in.features, at, 3) * whole);
    const Mirror<S> mirror = mirror_at(in, at);
    put(out.reflected, at, 0, mirror.out.unit.x);
    put(out.reflected, at, 1, mirror.out.unit.y);
    put(out.reflected, at, 2, mirror.out.unit.z);
    put(out.cosine, at, 0, mirror.cosine());
    if (!in.near.data) continue;
    for (int c = 0; c < 4; ++c) put(out.near, at, c, gather(in.near, at, c));
  }
}

template <class S>
void shade_inputs_bwd(const Covered<S>& in, Band band, const Inputs<const S>& v, const MapGrads<S>& grads) {
  using vf = typename Simd<S>::vf;
  const int width = in.view.width;
  const int64_t plane = int64_t(width) * in.view.height, first = int64_t(band.first) * width;
  const auto clear = [&](S* planes, int count) {
    for (int c = 0; c < count; ++c)
      __builtin_memset(planes + c * plane + first, 0, size_t(band.last - band.first) * width * sizeof(S));
  };
  clear(grads.features, in.channels);
  clear(grads.alpha, 1);
  clear(grads.normal, 3);
  if (in.near.data) clear(grads.near, 4);
  for (int64_t i = band.begin; i < band.end; i += LANES) {
    const Spots<S> at(in.pixels, i, band.end, width);
    const vf whole = reciprocal(gather(in.alpha, at, 0));
    vf v_alpha{};
    for (int c = 0; c < 4; ++c) {
      const vf g = (c < 3 ? pick(v.diffuse, at, c) : pick(v.roughness, at, 0)) * whole;
      scatter(grads.features + c * plane, width, at, g);
      v_alpha -= g * gather(in.features, at, c) * whole;
    }
    scatter(grads.alpha, width, at, v_alpha);
    const Mirror<S> mirror = mirror_at(in, at);
    const V3<S> v_normal = mirror.vjp(pick3(v.reflected, at), pick(v.cosine, at, 0));
    scatter(grads.normal, width, at, v_normal.x);
    scatter(grads.normal + plane, width, at, v_normal.y);
    scatter(grads.normal + 2 * plane, width, at, v_normal.z);
    if (!in.near.data) continue;
    for (int c = 0; c < 4; ++c) scatter(grads.near + c * plane, width, at, pick(v.near, at, c));
  }
}

// LANES pixels along a row from x on; past the row's end, its last pixel.
template <class S> inline typename Simd<S>::vf along(const Image<S>& image, int64_t y, int x, int width, int c) {
  const S* row = image.data + y * image.row + c * image.channel;
  if (image.column == 1 && x >= 0 && x + LANES <= width) return load(row + x);
  alignas(64) S out[LANES];
  for (int i = 0; i < LANES; ++i) {
    const int at = x + i < 0 ? 0 : x + i < width ? x + i : width - 1;
    out[i] = row[at * image.column];
  }
  return load(out);
}
template <class S> inline void write_along(S* row, int x, int width, typename Simd<S>::vf v) {
  if (x + LANES <= width) return store(row + x, v);
  for (int i = 0; x + i < width; ++i) row[x + i] = v[i];
}

template <class S> void shade_composite(const Composite<S>& in, Band band, S* image) {
  using vf = typename Simd<S>::vf;
  const int64_t plane = int64_t(in.width) * in.height;
  for (int64_t y = band.first; y < band.last; ++y)
    for (int x = 0; x < in.width; x += LANES) {
      const vf through = 1 - along(in.alpha, y, x, in.width, 0);
      for (int c = 0; c < 3; ++c) {
        vf value = through * in.backdrop[c];
        if (in.behind.data) value += along(in.behind, y, x, in.width, c);
        write_along(image + c * plane + y * in.width, x, in.width, value);
      }
    }
  for (int64_t i = band.begin; i < band.end; i += LANES) {
    const Spots<S> at(in.pixels, i, band.end, in.width);
    const vf a = gather(in.object_alpha, at, 0);
    for (int c = 0; c < 3; ++c) {
      const vf linear = pick(in.diffuse, at, c) + pick(in.radiance, at, c);
      S* to = image + c * plane;
      const Image<S> so_far{to, in.width, 1, plane};
      scatter(to, in.width, at, gather(so_far, at, 0) + a * Shown<S>(linear).color);
    }
  }
}

template <class S>
void shade_composite_bwd(const Composite<S>& in, Band band, const Image<S>& v_image, S* v_linear, S* v_object_alpha,
                         S* v_alpha) {
  using vf = typename Simd<S>::vf;
  for (int64_t y = band.first; y < band.last; ++y)
    for (int x = 0; x < in.width; x += LANES) {
      vf sum{};
      for (int c = 0; c < 3; ++c) sum -= along(v_image, y, x, in.width, c) * in.backdrop[c];
      write_along(v_alpha + y * in.width, x, in.width, sum);
      write_along(v_object_alpha + y * in.width, x, in.width, vf{});
    }
  for (int64_t i = band.begin; i < band.end; i += LANES) {
    const Spots<S> at(in.pixels, i, band.end, in.width);
    const vf a = gather(in.object_alpha, at, 0);
    vf v_a{};
    for (int c = 0; c < 3; ++c) {
      const Shown<S> shown(pick(in.diffuse, at, c) + pick(in.radiance, at, c));
      const vf v_color = gather(v_image, at, c);
      v_a += v_color * shown.color;
      put(Rows<S>{v_linear, 1, in.count}, at, c, shown.vjp(a * v_color));
    }
    scatter(v_object_alpha, in.width, at, v_a);
  }
}

// One image row's share of the agreement and its gradient by the steps between neighbouring points,
// six lines from `slopes` on: down (3), right (3); and by the normal, unless the row is another band's.
template <class S> double agreement_row(const Agreement<S>& in, int64_t y, bool own, S* slopes) {
  using vf = typename Simd<S>::vf;
  const View<S>& view = in.view;
  const int width = view.width;
  const int64_t plane = int64_t(width) * view.height, line = slope_row(width);
  const auto point = [&](int64_t py, vf x, int shift) {
    const int at = int(x[0]) + shift;
    const vf a = along(in.alpha, py, at, width, 0), z = along(in.depth, py, at, width, 0);
    const vf depth = z * reciprocal(max_of(a, all(S(1e-6))));
    return V3<S>{depth * ((x + (shift + S(0.5) - view.cx)) * (1 / view.fx)),
                 depth * ((S(py) + S(0.5) - view.cy) / view.fy), depth};
  };
  double sum = 0;
  vf counting{};
  for (int i = 0; i < LANES; ++i) counting[i] = S(i);
  for (int x0 = 0; x0 < width; x0 += LANES) {
    const vf x = counting + S(x0);
    V3<S> parts[3] = {};
    if (y > 0 && y < view.height - 1) {
      const auto inner = less(vf{}, x) & less(x, all(S(width - 1)));
      vf weight = keep(inner, along(in.alpha, y, x0, width, 0));
      if (any_lane(less(vf{}, weight) | less(weight, vf{}))) {
        const V3<S> above = point(y - 1, x, 0), below = point(y + 1, x, 0), left = point(y, x, -1);
        const V3<S> here = point(y, x, 0), next = point(y, x, 1), down = below - above, right = next - left;
        weight = keep(less(bend_of<S>(above.z, below.z, left.z, next.z, here.z) * view.fx, in.edge * here.z), weight);
        const V3<S> splatted{along(in.normal, y, x0, width, 0), along(in.normal, y, x0, width, 1),
                             along(in.normal, y, x0, width, 2)};
        const NormalPair<S> pair(down, right, splatted, view.world_from_cam, weight * -in.scale);
        const vf term = weight * (1 - pair.agreement);
        for (int i = 0; i < LANES; ++i) sum += double(term[i]);
        parts[0] = pair.v_down, parts[1] = pair.v_right, parts[2] = pair.v_normal;
      }
    }
    if (!in.v_normal) continue;
    for (int k = 0; k < 2; ++k) {
      store(slopes + (3 * k) * line + x0, parts[k].x);
      store(slopes + (3 * k + 1) * line + x0, parts[k].y);
      store(slopes + (3 * k + 2) * line + x0, parts[k].z);
    }
    if (!own) continue;
    S* v_normal = in.v_normal + y * width;
    write_along(v_normal, x0, width, parts[2].x);
    write_along(v_normal + plane, x0, width, parts[2].y);
    write_along(v_normal + 2 * plane, x0, width, parts[2].z);
  }
  return sum;
}

// Gradients by depth and alpha of a row, from the slopes of it and of its neighbours.
template <class S>
void agreement_row_vjp(const Agreement<S>& in, int64_t y, const S* above, const S* here, const S* below) {
  using vf = typename Simd<S>::vf;
  const View<S>& view = in.view;
  const int width = view.width;
  const int64_t line = slope_row(width);
  const auto part = [&](const S* slopes, int first, int x) {
    const Image<S> lines{slopes, 0, 1, line};
    return V3<S>{along(lines, 0, x, width, first), along(lines, 0, x, width, first + 1),
                 along(lines, 0, x, width, first + 2)};
  };
  for (int x = 0; x < width; x += LANES) {
    // a border's right slope is zero, so the pixel repeated past it adds nothing
    const V3<S> v = part(above, 0, x) - part(below, 0, x) + part(here, 3, x - 1) - part(here, 3, x + 1);
    vf columns{};
    for (int i = 0; i < LANES; ++i) columns[i] = S(x + i);
    const vf v_z = v.x * ((columns + (S(0.5) - view.cx)) * (1 / view.fx)) +
                   v.y * ((S(y) + S(0.5) - view.cy) / view.fy) + v.z;
    const vf a = along(in.alpha, y, x, width, 0), d = along(in.depth, y, x, width, 0);
    const vf share = reciprocal(max_of(a, all(S(1e-6))));
    write_along(in.v_depth + y * width, x, width, v_z * share);
    write_along(in.v_alpha + y * width, x, width, select(less(a, all(S(1e-6))), vf{}, -v_z * d * share * share));
  }
}

template <class S> void shade_agreement(const Agreement<S>& in, Band band, S* scratch, double* sums) {
  const int64_t row = 6 * slope_row(in.view.width);
  const auto slopes = [&](int y) { return scratch + (y + kSlopeRows) % kSlopeRows * row; };
  const auto compute = [&](int y) {
    if (y >= 0 && y < in.view.height) return agreement_row(in, y, y >= band.first && y < band.last, slopes(y));
    __builtin_memset(slopes(y), 0, size_t(row) * sizeof(S));
    return 0.0;
  };
  if (!in.v_normal) {
    for (int y = band.first; y < band.last; ++y) sums[y - band.first] = compute(y);
    return;
  }
  compute(band.first - 1);
  sums[0] = compute(band.first);
  for (int y = band.first; y < band.last; ++y) {
    const double next = compute(y + 1);
    if (y + 1 < band.last) sums[y + 1 - band.first] = next;
    agreement_row_vjp(in, y, slopes(y - 1), slopes(y), slopes(y + 1));
  }
}

// What smoothness compares of LANES pixels along a row.
template <class S> struct Flat {
  using vf = typename Simd<S>::vf;
  V3<S> normal, diffuse;
  vf length, depth;
  decltype(less(vf{}, vf{})) solid;

  Flat(const Smoothness<S>& in, int64_t y, int x) {
    const auto image = [&](const Image<S>& from, int c) { return along(from, y, x, in.width, c); };
    const vf alpha = image(in.alpha, 0), object = image(in.object_alpha, 0);
    const V3<S> sum{image(in.normal, 0), image(in.normal, 1), image(in.normal, 2)};
    length = max_of(sqrt_of(dot(sum, sum)), all(S(1e-8)));
    normal = reciprocal(length) * sum;
    const vf share = keep(less(all(in.shaded), object), reciprocal(max_of(object, all(S(1e-6)))));
    diffuse = share * V3<S>{image(in.features, 0), image(in.features, 1), image(in.features, 2)};
    depth = image(in.depth, 0) * reciprocal(max_of(alpha, all(S(1e-6))));
    solid = less(all(S(kSolid)), alpha);
  }
};

template <class V> inline V sign_of(V x) { return select(less(V{}, x), V{} + 1, select(less(x, V{}), V{} - 1, V{})); }

// One pixel's term with a neighbour: the loss, and the gradient by the pixel's unit normal on top of v.
template <class S>
typename Simd<S>::vf step_between(const Flat<S>& here, const Flat<S>& other, const Flat<S>& later, S scale, V3<S>& v) {
  using vf = typename Simd<S>::vf;
  const V3<S> d = other.diffuse - here.diffuse, n = here.normal - other.normal;
  const vf colors = abs_of(d.x) + abs_of(d.y) + abs_of(d.z);
  const vf relative = abs_of(other.depth - here.depth) * reciprocal(max_of(later.depth, all(S(1e-6))));
  const vf edge = colors * S(kDiffuseEdge) + relative * S(kDepthEdge);
  const vf weight = keep(here.solid & other.solid, exp_of(-edge) * scale);
  v = v + weight * V3<S>{sign_of(n.x), sign_of(n.y), sign_of(n.z)};
  return weight * (abs_of(n.x) + abs_of(n.y) + abs_of(n.z));
}

// Past the border `along` repeats it, which is no step.
template <class S> void shade_smoothness(const Smoothness<S>& in, Band band, double* sums) {
  using vf = typename Simd<S>::vf;
  const int64_t plane = int64_t(in.width) * in.height;
  for (int y = band.first; y < band.last; ++y) {
    double sum = 0;
    const int up = y > 0 ? y - 1 : 0, down = y + 1 < in.height ? y + 1 : y;
    for (int x = 0; x < in.width; x += LANES) {
      const Flat<S> here(in, y, x), right(in, y, x + 1), below(in, down, x);
      V3<S> v{};
      vf term = step_between(here, right, right, in.scale_x, v) + step_between(here, below, below, in.scale_y, v);
      const int lanes = in.width - x < LANES ? in.width - x : LANES;
      for (int i = 0; i < lanes; ++i) sum += double(term[i]);
      if (!in.v_normal) continue;
      step_between(here, Flat<S>(in, y, x - 1), here, in.scale_x, v);
      step_between(here, Flat<S>(in, up, x), here, in.scale_y, v);
      const auto long_enough = less(all(S(1e-8)), here.length);
      v = reciprocal(here.length) * (v - keep(long_enough, dot(v, here.normal)) * here.normal);
      S* out = in.v_normal + int64_t(y) * in.width;
      write_along(out, x, in.width, v.x);
      write_along(out + plane, x, in.width, v.y);
      write_along(out + 2 * plane, x, in.width, v.z);
    }
    sums[y - band.first] = sum;
  }
}

template <class S> constexpr ShadeKernels<S> shade_kernels() {
  return {shade_inputs<S>,        shade_inputs_bwd<S>, shade_composite<S>,
          shade_composite_bwd<S>, shade_agreement<S>,  shade_smoothness<S>};
}
