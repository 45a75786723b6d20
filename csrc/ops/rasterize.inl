// The tile kernels. One call draws one 16x16 tile; LANES pixels of a block (4 wide) go in one vector.
// Forward walks each block's own list with the sums in registers and stops when the block is opaque;
// backward walks the tile's surfels near to far once, with a surfel's gradient sums in registers, and
// writes them to the surfel's slot: no atomics, the same result for any number of threads.
//
// Blending gradient: with D = dL/dw of a surfel and R = sum of w D over it and everything behind it,
// dL/dalpha = T D - (R - w D) / (1 - alpha).

constexpr int kBlockW = 4, kBlockH = LANES / 4, kBlocks = kTilePixels / LANES, kBlocksX = kTile / kBlockW;

template <class S> struct Lanes {
  alignas(64) S x[LANES], y[LANES];
  Lanes() {
    for (int i = 0; i < LANES; ++i) x[i] = S(i % kBlockW) + S(0.5), y[i] = S(i / kBlockW) + S(0.5);
  }
};

template <class S> struct Hit {
  using vf = typename Simd<S>::vf;
  using vi = typename Simd<S>::vi;
  vf dx, dy, iq, u, v, rho, z;
  vi on_disc, has_hit, visible;
};
template <class S>
inline Hit<S> hit(const S* r, typename Simd<S>::vf x, typename Simd<S>::vf y, S near) {
  Hit<S> h;
  h.dx = x - r[0];
  h.dy = y - r[1];
  const auto q = 1 + r[6] * h.dx + r[7] * h.dy;
  h.iq = reciprocal(q > S(1e-9) ? q : all(S(1)));  // behind the horizon: finite and unused
  h.u = (r[2] * h.dx + r[3] * h.dy) * h.iq;
  h.v = (r[4] * h.dx + r[5] * h.dy) * h.iq;
  const auto rho3 = h.u * h.u + h.v * h.v;
  const auto rho2 = 2 * (h.dx * h.dx + h.dy * h.dy);
  h.on_disc = (rho3 <= rho2) & (q > S(1e-9));
  h.has_hit = (rho3 <= S(kHitRadius2)) & (q > S(1e-9));
  h.rho = h.on_disc ? rho3 : rho2;
  h.z = h.has_hit ? r[8] * h.iq : all(r[8]);
  h.visible = (h.rho < r[10]) & (h.z > near);
  return h;
}

template <class S, int C, int X>
void forward_tile(const RasterFrame<S>& f, int tile, int32_t* lists, int64_t capacity, S* maps) {
  using vf = typename Simd<S>::vf;
  using vi = typename Simd<S>::vi;
  static const Lanes<S> lanes;
  const int tx = tile % f.tiles_x * kTile, ty = tile / f.tiles_x * kTile;
  const int64_t begin = f.tile_start[tile], end = f.tile_start[tile + 1];
  int64_t count[kBlocks] = {};
  for (int64_t e = begin; e < end; ++e) {
    f.activity[e] = 0;
    const Box b = f.boxes[f.entries[e]];
    const int x0 = b.x0 > tx ? (b.x0 - tx) / kBlockW : 0, y0 = b.y0 > ty ? (b.y0 - ty) / kBlockH : 0;
    const int x1 = b.x1 < tx + kTile ? (b.x1 - tx) / kBlockW : kBlocksX - 1;
    const int y1 = b.y1 < ty + kTile ? (b.y1 - ty) / kBlockH : kBlocks / kBlocksX - 1;
    for (int y = y0; y <= y1; ++y)
      for (int x = x0; x <= x1; ++x) {
        const int block = y * kBlocksX + x;
        lists[block * capacity + count[block]++] = int32_t(e - begin);
      }
  }
  alignas(64) S out[C + 6][LANES];
  const int64_t plane = int64_t(f.width) * f.height;
  for (int block = 0; block < kBlocks; ++block) {
    const int bx = tx + block % kBlocksX * kBlockW, by = ty + block / kBlocksX * kBlockH;
    if (bx >= f.width || by >= f.height) continue;
    const vf x = load(lanes.x) + S(bx), y = load(lanes.y) + S(by);
    vf T = all(S(1)), sum[C], depth{}, median{}, distortion{}, m1{}, m2{};
    for (int c = 0; c < C; ++c) sum[c] = vf{};
    vi alive = vi{} - 1;
    const int32_t* list = lists + block * capacity;
    for (int64_t k = 0; k < count[block]; ++k) {
      const int64_t e = begin + list[k];
      const S* r = f.records + int64_t(f.entries[e]) * f.stride;
      if (k + 4 < count[block]) {
        const S* next = f.records + int64_t(f.entries[begin + list[k + 4]]) * f.stride;
        __builtin_prefetch(next);
        __builtin_prefetch(next + 16);
      }
      const Hit<S> h = hit(r, x, y, f.near);
      vi on = h.visible & alive;
      if (!any_lane(on)) continue;
      vf alpha = min_of(r[9] * exp_of(h.rho * S(-0.5)), all(S(kMaxAlpha)));
      alpha = on ? alpha : vf{};
      const vf next_T = T - T * alpha;
      const vi full = next_T < S(kMinTransmittance);
      alive &= ~full;
      on &= ~full;
      const vf w = on ? alpha * T : vf{};
      f.activity[e] |= uint64_t(1) << block;
      for (int c = 0; c < C; ++c) sum[c] += r[kRecordHead + c] * w;
      if (X >= 1) {
        depth += w * h.z;
        median = (on & (T > S(0.5)) & (next_T <= S(0.5))) ? h.z : median;
      }
      if (X >= 2) {
        const vf m = f.near * reciprocal(h.z);
        distortion += w * (m * m * (1 - T) + m2 - 2 * m * m1);
        m1 += w * m;
        m2 += w * m * m;
      }
      T = full ? T : next_T;
      if (!any_lane(alive)) break;
    }
    for (int c = 0; c < C; ++c) store(out[c], sum[c]);
    store(out[C], 1 - T);
    store(out[C + 1], depth);
    store(out[C + 2], median);
    store(out[C + 3], distortion);
    store(out[C + 4], m1);
    store(out[C + 5], m2);
    const int planes = C + 1 + (X >= 1 ? 2 : 0) + (X >= 2 ? 1 : 0);
    for (int row = 0; row < kBlockH && by + row < f.height; ++row)
      for (int col = 0; col < kBlockW && bx + col < f.width; ++col) {
        const int64_t pixel = int64_t(by + row) * f.width + bx + col;
        const int lane = row * kBlockW + col;
        for (int c = 0; c < planes; ++c) maps[c * plane + pixel] = out[c][lane];
        if (X >= 2) f.moments[pixel] = out[C + 4][lane], f.moments[plane + pixel] = out[C + 5][lane];
      }
  }
}

template <class S, int C, int X>
void backward_tile(const RasterFrame<S>& f, int tile, const S* maps, const S* v_maps, S* slots) {
  using vf = typename Simd<S>::vf;
  using vi = typename Simd<S>::vi;
  static const Lanes<S> lanes;
  constexpr int planes = C + 1 + (X >= 1 ? 2 : 0) + (X >= 2 ? 1 : 0), width = kGradHead + C;
  const int tx = tile % f.tiles_x * kTile, ty = tile / f.tiles_x * kTile;
  const int64_t begin = f.tile_start[tile], end = f.tile_start[tile + 1];
  const int64_t plane = int64_t(f.width) * f.height;
  // Per block: incoming gradients, transmittance so far (negative once a pixel has stopped), R, moments.
  alignas(64) S g[kBlocks][planes][LANES], T_[kBlocks][LANES], R_[kBlocks][LANES], M[kBlocks][X >= 2 ? 3 : 1][LANES];
  for (int block = 0; block < kBlocks; ++block)
    for (int lane = 0; lane < LANES; ++lane) {
      const int px = tx + block % kBlocksX * kBlockW + lane % kBlockW;
      const int py = ty + block / kBlocksX * kBlockH + lane / kBlockW;
      const bool inside = px < f.width && py < f.height;
      const int64_t pixel = inside ? int64_t(py) * f.width + px : 0;
      S total = 0;
      for (int c = 0; c < planes; ++c) {
        const S v = inside ? v_maps[c * plane + pixel] : S(0);
        g[block][c][lane] = v;
        if (c == C + 2) continue;  // the median's gradient does not pass through weights
        total += v * maps[c * plane + pixel] * (c == C + 3 ? S(2) : S(1));
      }
      R_[block][lane] = total;
      T_[block][lane] = inside ? S(1) : S(-1);
      if (X >= 2) {
        M[block][0][lane] = maps[C * plane + pixel];
        M[block][X >= 2 ? 1 : 0][lane] = f.moments[pixel];
        M[block][X >= 2 ? 2 : 0][lane] = f.moments[plane + pixel];
      }
    }
  for (int64_t e = begin; e < end; ++e) {
    uint64_t act = f.activity[e];
    S* slot = slots + int64_t(f.slots[e]) * width;
    if (e + 4 < end) {
      const S* next = f.records + int64_t(f.entries[e + 4]) * f.stride;
      __builtin_prefetch(next);
      __builtin_prefetch(next + 16);
      __builtin_prefetch(slots + int64_t(f.slots[e + 4]) * width, 1);
    }
    if (!act) {
      for (int c = 0; c < width; ++c) slot[c] = 0;
      continue;
    }
    const S* r = f.records + int64_t(f.entries[e]) * f.stride;
    vf G[(width + 15) / 16 * 16];
    for (vf& sum : G) sum = vf{};
    for (; act; act &= act - 1) {
      const int block = __builtin_ctzll(act);
      const vf x = load(lanes.x) + S(tx + block % kBlocksX * kBlockW);
      const vf y = load(lanes.y) + S(ty + block / kBlocksX * kBlockH);
      const Hit<S> h = hit(r, x, y, f.near);
      const vf T = load(T_[block]);
      vi on = h.visible & (T > 0);
      const vf bump = exp_of(h.rho * S(-0.5)), raw = r[9] * bump;
      vf alpha = min_of(raw, all(S(kMaxAlpha)));
      alpha = on ? alpha : vf{};
      const vf next_T = T - T * alpha;
      const vi full = on & (next_T < S(kMinTransmittance));
      on &= ~full;
      const vf w = on ? alpha * T : vf{};
      store(T_[block], full ? -T : next_T);
      vf D = load(g[block][C]), gz{};
      for (int c = 0; c < C; ++c) {
        const vf gc = load(g[block][c]);
        D += r[kRecordHead + c] * gc;
        G[kGradHead + c] += w * gc;
      }
      if (X >= 1) {
        const vf g_depth = load(g[block][X >= 1 ? C + 1 : 0]);
        D += h.z * g_depth;
        gz = w * g_depth;
        gz += (on & (T > S(0.5)) & (next_T <= S(0.5))) ? load(g[block][X >= 1 ? C + 2 : 0]) : vf{};
      }
      if (X >= 2) {
        const vf gd = load(g[block][X >= 2 ? C + 3 : 0]), iz = reciprocal(h.z), m = f.near * iz;
        const vf A = load(M[block][0]), m1 = load(M[block][X >= 2 ? 1 : 0]), m2 = load(M[block][X >= 2 ? 2 : 0]);
        D += gd * (m * m * A + m2 - 2 * m * m1);
        gz -= 2 * w * gd * (m * A - m1) * m * iz;
      }
      const vf R = load(R_[block]) - w * D;
      store(R_[block], R);
      vf g_alpha = on ? T * D - R * reciprocal(1 - alpha) : vf{};
      g_alpha = raw > S(kMaxAlpha) ? vf{} : g_alpha;
      G[9] += g_alpha * bump;
      const vf g_rho = S(-0.5) * g_alpha * alpha;
      const vf on_disc = h.on_disc ? g_rho : vf{}, low_pass = g_rho - on_disc;
      const vf gu = 2 * h.u * on_disc, gv = 2 * h.v * on_disc;
      const vf gpx = gu * h.iq, gpy = gv * h.iq;
      const vf gz_disc = h.has_hit ? gz * h.iq : vf{};
      G[8] += h.has_hit ? gz_disc : gz;
      const vf gq = -(h.u * gpx + h.v * gpy) - gz_disc * h.z;
      const vf gdx = gpx * r[2] + gpy * r[4] + gq * r[6] + 4 * h.dx * low_pass;
      const vf gdy = gpx * r[3] + gpy * r[5] + gq * r[7] + 4 * h.dy * low_pass;
      G[0] -= gdx;
      G[1] -= gdy;
      G[2] += gpx * h.dx;
      G[3] += gpx * h.dy;
      G[4] += gpy * h.dx;
      G[5] += gpy * h.dy;
      G[6] += gq * h.dx;
      G[7] += gq * h.dy;
      G[10] += abs_of(gdx);
      G[11] += abs_of(gdy);
    }
    alignas(64) S sums[(width + 15) / 16 * 16];
    lane_sums(G, width, sums);
    for (int c = 0; c < width; ++c) slot[c] = sums[c];
  }
}

template <class S, int C> RasterKernels<S> raster_kernels_c(Extra extra) {
  switch (extra) {
    case Extra::none: return {forward_tile<S, C, 0>, backward_tile<S, C, 0>};
    case Extra::depth: return {forward_tile<S, C, 1>, backward_tile<S, C, 1>};
    default: return {forward_tile<S, C, 2>, backward_tile<S, C, 2>};
  }
}
template <class S> RasterKernels<S> raster_kernels(int channels, Extra extra) {
  switch (channels) {
    case 4: return raster_kernels_c<S, 4>(extra);
    case 8: return raster_kernels_c<S, 8>(extra);
    case 12: return raster_kernels_c<S, 12>(extra);
    case 16: return raster_kernels_c<S, 16>(extra);
    default: return raster_kernels_c<S, 20>(extra);
  }
}
