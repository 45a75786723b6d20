// LANES directions at a time find their texels' addresses and weights; then each direction blends its
// 8 texels as vectors of the 4 channels. Backward gathers the same texels for the gradients by u, v and
// level. The map's gradient is scattered by owners of rows: every owner walks all the directions in order
// and adds to its own rows only, so each texel sums the same terms in the same order for any number of
// owners, without atomics. Skipping LANES foreign directions costs a few instructions.

template <class S> struct Texel;
template <> struct Texel<float> {
  typedef float v4 __attribute__((vector_size(16)));
};
template <> struct Texel<double> {
  typedef double v4 __attribute__((vector_size(32)));
};
template <class S> inline typename Texel<S>::v4 texel(const S* p) {
  typename Texel<S>::v4 v;
  __builtin_memcpy(&v, p, sizeof v);
  return v;
}

// A clang vector has no conversion between lane types by assignment.
template <class S> inline typename Simd<S>::vf lanes_to_float(typename Simd<S>::vi x) {
  return __builtin_convertvector(x, typename Simd<S>::vf);
}
template <class S> inline typename Simd<S>::vi floor_above(typename Simd<S>::vf x, S least) {
  return __builtin_convertvector(x - least, typename Simd<S>::vi) + int(least);
}

// Angle of (x, y) in -pi..pi; 0 at the origin. Polynomial of Cephes atanf, error 2e-7.
inline vf32 atan2_of(vf32 y, vf32 x) {
  const vf32 ax = abs_of(x), ay = abs_of(y);
  const vf32 t = min_of(ax, ay) * reciprocal(max_of(max_of(ax, ay), all(1e-30f)));
  const vi32 wide = t > 0.41421356f;
  const vf32 s = wide ? (t - 1) * reciprocal(t + 1) : t, z = s * s;
  vf32 p = 8.05374449538e-2f * z - 1.38776856032e-1f;
  p = p * z + 1.99777106478e-1f;
  p = p * z - 3.33329491539e-1f;
  vf32 angle = p * z * s + s + (wide ? all(0.785398163f) : vf32{});
  angle = ay > ax ? 1.57079633f - angle : angle;
  angle = x < 0 ? 3.14159265f - angle : angle;
  return y < 0 ? -angle : angle;
}
inline Simd<double>::vf atan2_of(Simd<double>::vf y, Simd<double>::vf x) {
  Simd<double>::vf r;
  for (int i = 0; i < LANES; ++i) r[i] = __builtin_atan2(y[i], x[i]);
  return r;
}

constexpr double kPi = 3.14159265358979323846;

template <class S> struct MipDirection {
  typename Simd<S>::vf x, y, z, r2, r;

  MipDirection(const SphMipQuery<S>& q, int64_t begin) {
    alignas(64) S xyz[3][LANES];
    for (int i = 0; i < LANES; ++i) {
      const int64_t k = begin + i < q.count ? begin + i : q.count - 1;
      for (int c = 0; c < 3; ++c) xyz[c][i] = q.directions[k * q.direction_row + c * q.direction_column];
    }
    x = load(xyz[0]), y = load(xyz[1]), z = load(xyz[2]);
    r2 = x * x + y * y;
    r = sqrt_of(r2 + S(1e-24));
  }
};

template <class S> struct MipPoint {
  typename Simd<S>::vf u, v, level;
};
template <class S> MipPoint<S> mip_point(const SphMipQuery<S>& q, int64_t begin) {
  const MipDirection<S> d(q, begin);
  MipPoint<S> p;
  p.u = atan2_of(d.y, d.x) * S(0.5 / kPi);
  p.u = p.u < 0 ? p.u + 1 : p.u;
  p.v = atan2_of(d.r, d.z) * S(1 / kPi);
  alignas(64) S rough[LANES];
  for (int i = 0; i < LANES; ++i)
    rough[i] = q.roughness[(begin + i < q.count ? begin + i : q.count - 1) * q.roughness_step];
  // The operand order turns a NaN into the bound.
  p.level = min_of(max_of(load(rough) * S(q.map.levels), all(q.min_level)), all(S(q.map.levels - 1)));
  return p;
}

// Where a block of points falls in one level: addresses within the level, in texels, and weights.
template <class S> struct MipCell {
  alignas(64) S wx[LANES], wy[LANES];
  alignas(64) typename Simd<S>::vi corner[2][2], row[2], level, shrink;
};
template <class S> MipCell<S> mip_cell(const MipPoint<S>& p, typename Simd<S>::vi level, int height, int width) {
  using vf = typename Simd<S>::vf;
  using vi = typename Simd<S>::vi;
  MipCell<S> c;
  const vi h = (vi{} + height) >> level, w = (vi{} + width) >> level;
  const vf x = p.u * lanes_to_float<S>(w) - S(0.5), y = p.v * lanes_to_float<S>(h) - S(0.5);
  const vi col = floor_above(x, S(-1));
  vi row = floor_above(y, S(-1));
  row = row < -1 ? vi{} - 1 : row;
  row = row > h - 1 ? h - 1 : row;
  store(c.wx, x - lanes_to_float<S>(col));
  store(c.wy, y - lanes_to_float<S>(row));
  c.level = level;
  for (int k = 0; k < 2; ++k) {
    vi r = row + k;
    const vi over = (r < 0) | (r >= h);  // past a pole: the same row on the other side
    const vi turn = over ? w >> 1 : vi{};
    r = r < 0 ? vi{} : r;
    r = r > h - 1 ? h - 1 : r;
    c.row[k] = r;
    for (int j = 0; j < 2; ++j) c.corner[k][j] = r * w + ((col + j + turn) & (w - 1));
  }
  return c;
}

template <class S> struct MipCells {
  MipCell<S> near, far;              // the finer and the coarser level
  alignas(64) S blend[LANES];        // the coarser level's share
};
template <class S> MipCells<S> mip_cells(const MipPoint<S>& p, const MipMap<const S>& map) {
  using vi = typename Simd<S>::vi;
  const vi fine = __builtin_convertvector(p.level, vi);
  const vi coarse = fine + 1 > map.levels - 1 ? vi{} + (map.levels - 1) : fine + 1;
  MipCells<S> cells{mip_cell(p, fine, map.height, map.width), mip_cell(p, coarse, map.height, map.width), {}};
  store(cells.blend, p.level - lanes_to_float<S>(fine));
  return cells;
}

// The four texels of one lane.
template <class S> struct MipCorners {
  typename Texel<S>::v4 t[2][2];
  S wx, wy;

  MipCorners(const MipMap<const S>& map, const MipCell<S>& c, int lane) : wx(c.wx[lane]), wy(c.wy[lane]) {
    const S* level = map.level[c.level[lane]];
    for (int k = 0; k < 2; ++k)
      for (int j = 0; j < 2; ++j) t[k][j] = texel(level + int64_t(c.corner[k][j][lane]) * kMipChannels);
  }
  typename Texel<S>::v4 row(int k) const { return t[k][0] + wx * (t[k][1] - t[k][0]); }
  typename Texel<S>::v4 value() const { return row(0) + wy * (row(1) - row(0)); }
  typename Texel<S>::v4 by_x() const {
    const auto top = t[0][1] - t[0][0], bottom = t[1][1] - t[1][0];
    return top + wy * (bottom - top);
  }
  typename Texel<S>::v4 by_y() const { return row(1) - row(0); }
};

template <class S> void mip_lookup(const SphMipQuery<S>& q, int64_t begin, int64_t end, S* out) {
  for (int64_t at = begin; at < end; at += LANES) {
    const int lanes = end - at < LANES ? int(end - at) : LANES;
    const MipPoint<S> p = mip_point(q, at);
    const typename Simd<S>::vf coordinates[3] = {p.u, p.v, p.level};
    for (int c = 0; c < 3; ++c)
      __builtin_memcpy(q.coordinates + c * q.count + at, &coordinates[c], size_t(lanes) * sizeof(S));
    const MipCells<S> cells = mip_cells(p, q.map);
    for (int i = 0; i < lanes; ++i) {
      const auto fine = MipCorners<S>(q.map, cells.near, i).value();
      const auto coarse = MipCorners<S>(q.map, cells.far, i).value();
      const auto value = fine + cells.blend[i] * (coarse - fine);
      __builtin_memcpy(out + (at + i) * kMipChannels, &value, sizeof value);
    }
  }
}

template <class S> MipPoint<S> mip_point_again(const SphMipQuery<S>& q, int64_t at) {
  MipPoint<S> p{};
  typename Simd<S>::vf* parts[3] = {&p.u, &p.v, &p.level};
  const int64_t lanes = q.count - at < LANES ? q.count - at : LANES;
  for (int c = 0; c < 3; ++c)
    __builtin_memcpy(parts[c], q.coordinates + c * q.count + at, size_t(lanes) * sizeof(S));
  return p;
}

template <class V> inline auto dot4(V a, V b) {
  const V p = a * b;
  return (p[0] + p[2]) + (p[1] + p[3]);
}

// Gradients by u, v and level to directions and roughness.
template <class S>
void mip_polar_vjp(const SphMipQuery<S>& q, int64_t at, int lanes, S (&by)[3][LANES], const SphMipGrads<S>& grads) {
  using vf = typename Simd<S>::vf;
  const MipDirection<S> d(q, at);
  const vf by_azimuth = load(by[0]) * S(0.5 / kPi) * reciprocal(max_of(d.r2, all(S(kPoleSine * kPoleSine))));
  const vf by_polar = load(by[1]) * S(1 / kPi) * reciprocal(d.r * d.r + d.z * d.z);
  const vf by_r = by_polar * d.z * reciprocal(d.r);
  alignas(64) S g[3][LANES];
  store(g[0], by_r * d.x - by_azimuth * d.y);
  store(g[1], by_r * d.y + by_azimuth * d.x);
  store(g[2], -by_polar * d.r);
  for (int i = 0; i < lanes; ++i) {
    for (int c = 0; c < 3; ++c) grads.directions[(at + i) * 3 + c] = g[c][i];
    const S level = q.roughness[(at + i) * q.roughness_step] * S(q.map.levels);
    const bool free = level >= q.min_level && level <= S(q.map.levels - 1);
    grads.roughness[at + i] = free ? by[2][i] * S(q.map.levels) : S(0);
  }
}

template <class S>
void mip_lookup_bwd(const SphMipQuery<S>& q, int64_t begin, int64_t end, const S* v_out,
                    const SphMipGrads<S>& grads) {
  for (int64_t at = begin; at < end; at += LANES) {
    const int lanes = end - at < LANES ? int(end - at) : LANES;
    const MipCells<S> cells = mip_cells(mip_point_again(q, at), q.map);
    alignas(64) S by[3][LANES] = {};
    for (int i = 0; i < lanes; ++i) {
      const auto g = texel(v_out + (at + i) * kMipChannels);
      const MipCorners<S> fine(q.map, cells.near, i), coarse(q.map, cells.far, i);
      const S b = cells.blend[i];
      const int fine_level = int(cells.near.level[i]), coarse_level = int(cells.far.level[i]);
      const S fine_width = S(q.map.width >> fine_level), coarse_width = S(q.map.width >> coarse_level);
      const S fine_height = S(q.map.height >> fine_level), coarse_height = S(q.map.height >> coarse_level);
      by[0][i] = dot4(g, (1 - b) * fine_width * fine.by_x() + b * coarse_width * coarse.by_x());
      by[1][i] = dot4(g, (1 - b) * fine_height * fine.by_y() + b * coarse_height * coarse.by_y());
      by[2][i] = dot4(g, coarse.value() - fine.value());
    }
    mip_polar_vjp(q, at, lanes, by, grads);
  }
}

// Adds one cell's share to the rows of one owner.
template <class S>
void mip_scatter_cell(const MipCell<S>& c, typename Simd<S>::vi first_row, MipRows rows, const S* share,
                      const S* v_out, int lanes, const MipMap<S>& grads) {
  using vi = typename Simd<S>::vi;
  const vi inside = (c.level >= rows.first_level) & (c.level < rows.last_level);
  vi mine[2];
  for (int k = 0; k < 2; ++k) {
    const vi row = c.row[k] + first_row;
    mine[k] = inside & (row >= rows.begin) & (row < rows.end);
  }
  if (!any_lane(mine[0] | mine[1])) return;
  for (int i = 0; i < lanes; ++i) {
    S* level = grads.level[c.level[i]];
    const auto g = share[i] * texel(v_out + i * kMipChannels);
    for (int k = 0; k < 2; ++k) {
      if (!mine[k][i]) continue;
      const auto along = (k ? c.wy[i] : 1 - c.wy[i]) * g;
      for (int j = 0; j < 2; ++j) {
        S* p = level + int64_t(c.corner[k][j][i]) * kMipChannels;
        const auto sum = texel(p) + (j ? c.wx[i] : 1 - c.wx[i]) * along;
        __builtin_memcpy(p, &sum, sizeof sum);
      }
    }
  }
}

template <class S> void mip_scatter(const SphMipQuery<S>& q, const S* v_out, const MipMap<S>& grads, MipRows rows) {
  using vi = typename Simd<S>::vi;
  // Rows above level l in the stack: height of levels first..l-1, that is 2 (h >> first) - 2 (h >> l).
  const int top = 2 * (q.map.height >> rows.first_level);
  for (int64_t at = 0; at < q.count; at += LANES) {
    const int lanes = q.count - at < LANES ? int(q.count - at) : LANES;
    const MipCells<S> cells = mip_cells(mip_point_again(q, at), q.map);
    alignas(64) S share[2][LANES];
    store(share[0], 1 - load(cells.blend));
    store(share[1], load(cells.blend));
    for (int k = 0; k < 2; ++k) {
      const MipCell<S>& c = k ? cells.far : cells.near;
      const vi first_row = top - (((vi{} + q.map.height) >> c.level) << 1);
      mip_scatter_cell(c, first_row, rows, share[k], v_out + at * kMipChannels, lanes, grads);
    }
  }
}

template <class S> constexpr SphMipKernels<S> sph_mip_kernels() {
  return {mip_lookup<S>, mip_lookup_bwd<S>, mip_scatter<S>};
}
