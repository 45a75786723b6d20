// The tile kernels. One call draws one 16x16 tile; LANES pixels of a block (4 wide) go in one vector.
// Forward takes the tile's surfels near to far in batches: an exact test finds the blocks that each one
// reaches, then every block walks its own list with the sums in registers. Backward walks the surfels
// once, with a surfel's gradient sums in registers, and writes them to the surfel's slot: no atomics,
// the same result for any number of threads.
//
// Blending gradient: with D = dL/dw of a surfel and R = sum of w D over it and everything behind it,
// dL/dalpha = T D - (R - w D) / (1 - alpha).

constexpr int kBlockW = 4, kBlockH = LANES / 4, kBlocks = kTilePixels / LANES, kBlocksX = kTile / kBlockW;
constexpr int kBatch = 128;
constexpr int planes_of(int channels, int extra) { return channels + 1 + (extra >= 1 ? 2 : 0) + (extra >= 2 ? 1 : 0); }

template <class S> struct Lanes {
  alignas(64) S x[LANES], y[LANES];                     // pixel centres in a block
  alignas(64) S block_x[kBlocks], block_y[kBlocks];     // first pixel centres of the tile's blocks
  Lanes() {
    for (int i = 0; i < LANES; ++i) x[i] = S(i % kBlockW) + S(0.5), y[i] = S(i / kBlockW) + S(0.5);
    for (int b = 0; b < kBlocks; ++b)
      block_x[b] = S(b % kBlocksX * kBlockW) + S(0.5), block_y[b] = S(b / kBlocksX * kBlockH) + S(0.5);
  }
};

template <class S> struct Hit {
  using vf = typename Simd<S>::vf;
  using vm = typename Simd<S>::vm;
  vf dx, dy, iq, u, v, rho, z;
  vm on_disc, has_hit, visible;
};
template <class S>
inline __attribute__((always_inline)) Hit<S> hit(const S* r, typename Simd<S>::vf x, typename Simd<S>::vf y, S near) {
  Hit<S> h;
  h.dx = x - r[0];
  h.dy = y - r[1];
  const auto q = 1 + r[6] * h.dx + r[7] * h.dy;
  const auto in_front = less(all(S(1e-9)), q);  // not behind the horizon
  h.iq = keep(in_front, reciprocal(q));
  h.u = (r[2] * h.dx + r[3] * h.dy) * h.iq;
  h.v = (r[4] * h.dx + r[5] * h.dy) * h.iq;
  const auto rho3 = h.u * h.u + h.v * h.v;
  const auto rho2 = S(kLowPass) * (h.dx * h.dx + h.dy * h.dy);
  h.on_disc = at_most(rho3, rho2) & in_front;
  h.has_hit = at_most(rho3, all(S(kHitRadius2))) & in_front;
  h.rho = select(h.on_disc, rho3, rho2);
  h.z = select(h.has_hit, r[8] * h.iq, all(r[8]));
  h.visible = less(h.rho, all(r[10])) & less(all(near), h.z);
  return h;
}

// The value between lo and hi that is nearest to `to`.
template <class V> inline V clamped(V to, V lo, V hi) { return min_of(max_of(to, lo), hi); }

// Which blocks of the tile at (tx, ty) have pixels that the surfel's contour or its low-pass circle
// reaches; now and then one too many. The least of a convex quadratic over a rectangle lies at its own
// middle or on a side that faces it.
template <class S>
inline uint64_t reached_blocks(const Lanes<S>& lanes, const S* r, const Box* box, int tx, int ty) {
  using vf = typename Simd<S>::vf;
  constexpr int wide = kBlockW - 1, high = kBlockH - 1;
  int first = 0, last = kBlocks - 1;
  if (kBlocks > LANES) {  // several vectors: only those within the box
    const int y0 = box->y0 > ty ? (box->y0 - ty) / kBlockH : 0;
    const int y1 = box->y1 < ty + kTile ? (box->y1 - ty) / kBlockH : kTile / kBlockH - 1;
    first = y0 * kBlocksX / LANES * LANES, last = y1 * kBlocksX + kBlocksX - 1;
  }
  const S* k = r + kContour;
  uint64_t reached = 0;
  for (; first <= last; first += LANES) {
    const vf x = load(lanes.block_x + first) + S(tx), y = load(lanes.block_y + first) + S(ty);
    const vf x0 = x - k[0], y0 = y - k[1], x1 = x0 + S(wide), y1 = y0 + S(high);
    const vf xa = clamped(vf{}, x0, x1), ya = clamped(k[5] * xa, y0, y1);
    const vf yb = clamped(vf{}, y0, y1), xb = clamped(k[6] * yb, x0, x1);
    const vf a = xa * (k[2] * xa + k[3] * ya) + k[4] * ya * ya;
    const vf b = xb * (k[2] * xb + k[3] * yb) + k[4] * yb * yb;
    const vf cx = clamped(vf{}, x - r[0], x - r[0] + S(wide)), cy = clamped(vf{}, y - r[1], y - r[1] + S(high));
    const auto near = less(min_of(a, b), all(S(1.02))) | less(cx * cx + cy * cy, all(S(1.002 / kLowPass) * r[10]));
    reached |= bits_of(near) << first;
  }
  return reached;
}

// A block's sums in progress: channels, T, depth, median, distortion and its two moments.
template <class S, int C> struct BlockSums {
  alignas(64) S channel[C][LANES];
  alignas(64) S T[LANES], depth[LANES], median[LANES], distortion[LANES], m1[LANES], m2[LANES];
  typename Simd<S>::vm alive;
};

// Blends the listed surfels into one block, near to far; true while a pixel is still open.
template <class S, int C, int X>
inline bool blend(S near, const S* const* records, const uint8_t* list, int n, typename Simd<S>::vf x,
                  typename Simd<S>::vf y, BlockSums<S, C>& sums, uint64_t* activity, uint64_t bit) {
  using vf = typename Simd<S>::vf;
  using vm = typename Simd<S>::vm;
  vf sum[C], T = load(sums.T), depth = load(sums.depth), median = load(sums.median);
  vf distortion = load(sums.distortion), m1 = load(sums.m1), m2 = load(sums.m2);
  vm alive = sums.alive;
#pragma GCC unroll 20
  for (int c = 0; c < C; ++c) sum[c] = load(sums.channel[c]);
  for (int k = 0; k < n; ++k) {
    const S* r = records[list[k]];
    const Hit<S> h = hit(r, x, y, near);
    vm on = h.visible & alive;
    if (!any_lane(on)) continue;
    const vf alpha = min_of(r[9] * exp_of(h.rho * S(-0.5)), all(S(kMaxAlpha)));
    const vf next_T = T - T * alpha;
    const vm full = on & less(next_T, all(S(kMinTransmittance)));
    alive = alive & ~full;
    on = on & ~full;
    const vf w = keep(on, alpha * T);
    activity[list[k]] |= bit;
#pragma GCC unroll 20
    for (int c = 0; c < C; ++c) sum[c] += r[kRecordHead + c] * w;
    if (X >= 1) {
      depth += w * h.z;
      median = select(on & less(all(S(0.5)), T) & at_most(next_T, all(S(0.5))), h.z, median);
    }
    if (X >= 2) {
      const vf m = near * reciprocal(h.z);
      distortion += w * (m * m * (1 - T) + m2 - 2 * m * m1);
      m1 += w * m;
      m2 += w * m * m;
    }
    T = select(on, next_T, T);
    if (!any_lane(alive)) break;
  }
#pragma GCC unroll 20
  for (int c = 0; c < C; ++c) store(sums.channel[c], sum[c]);
  store(sums.T, T);
  store(sums.depth, depth);
  store(sums.median, median);
  store(sums.distortion, distortion);
  store(sums.m1, m1);
  store(sums.m2, m2);
  sums.alive = alive;
  return any_lane(alive);
}

// Writes a plane of the tile: lanes(block) gives the block's values.
template <class S, class F> inline void store_plane(const RasterFrame<S>& f, int tx, int ty, S* plane, F&& lanes) {
  for (int row = 0; row < kTile && ty + row < f.height; ++row)
    for (int column = 0; column < kBlocksX; ++column) {
      const S* from = lanes(row / kBlockH * kBlocksX + column) + row % kBlockH * kBlockW;
      S* to = plane + int64_t(ty + row) * f.width + tx + column * kBlockW;
      const int left = f.width - tx - column * kBlockW;
      if (left >= kBlockW)
        __builtin_memcpy(to, from, kBlockW * sizeof(S));
      else
        for (int i = 0; i < left; ++i) to[i] = from[i];
    }
}
// The reverse, zeros outside the image.
template <class S, class F> inline void load_plane(const RasterFrame<S>& f, int tx, int ty, const S* plane, F&& lanes) {
  for (int row = 0; row < kTile; ++row)
    for (int column = 0; column < kBlocksX; ++column) {
      S* to = lanes(row / kBlockH * kBlocksX + column) + row % kBlockH * kBlockW;
      const S* from = plane + int64_t(ty + row) * f.width + tx + column * kBlockW;
      const int left = ty + row < f.height ? f.width - tx - column * kBlockW : 0;
      if (left >= kBlockW)
        __builtin_memcpy(to, from, kBlockW * sizeof(S));
      else
        for (int i = 0; i < kBlockW; ++i) to[i] = i < left ? from[i] : S(0);
    }
}

// Which pixels of a block, whose first is (x, y), are drawn.
template <class S> inline typename Simd<S>::vm drawn_lanes(const RasterFrame<S>& f, const Lanes<S>& lanes, int x, int y) {
  const auto inside = less(load(lanes.x) + S(x), all(S(f.width))) & less(load(lanes.y) + S(y), all(S(f.height)));
  if (!f.needed) return inside;
  uint8_t needed[LANES] = {};
  for (int row = 0; row < kBlockH && y + row < f.height; ++row) {
    const uint8_t* from = f.needed + int64_t(y + row) * f.width + x;
    if (x + kBlockW <= f.width)
      __builtin_memcpy(needed + row * kBlockW, from, kBlockW);
    else
      for (int i = 0; x + i < f.width; ++i) needed[row * kBlockW + i] = from[i];
  }
  alignas(64) S drawn[LANES];
  for (int i = 0; i < LANES; ++i) drawn[i] = S(needed[i]);
  return inside & less(typename Simd<S>::vf{}, load(drawn));
}

template <class S, int C, int X>
void store_maps(const RasterFrame<S>& f, int tx, int ty, BlockSums<S, C>* sums, S* maps) {
  const int64_t plane = int64_t(f.width) * f.height;
  for (int c = 0; c < C; ++c)
    store_plane(f, tx, ty, maps + c * plane, [=](int block) { return sums[block].channel[c]; });
  for (int block = 0; block < kBlocks; ++block) store(sums[block].T, 1 - load(sums[block].T));
  store_plane(f, tx, ty, maps + C * plane, [=](int block) { return sums[block].T; });
  if (X >= 1) {
    store_plane(f, tx, ty, maps + (C + 1) * plane, [=](int block) { return sums[block].depth; });
    store_plane(f, tx, ty, maps + (C + 2) * plane, [=](int block) { return sums[block].median; });
  }
  if (X >= 2) {
    store_plane(f, tx, ty, maps + (C + 3) * plane, [=](int block) { return sums[block].distortion; });
    store_plane(f, tx, ty, f.moments, [=](int block) { return sums[block].m1; });
    store_plane(f, tx, ty, f.moments + plane, [=](int block) { return sums[block].m2; });
  }
}

template <class S, int C, int X> void forward_tile(const RasterFrame<S>& f, int tile, S* maps) {
  using vf = typename Simd<S>::vf;
  static const Lanes<S> lanes;
  const int tx = tile % f.tiles_x * kTile, ty = tile / f.tiles_x * kTile;
  const int64_t end = f.tile_start[tile + 1];
  BlockSums<S, C> sums[kBlocks];
  __builtin_memset(sums, 0, sizeof sums);
  uint64_t open = 0;
  for (int block = 0; block < kBlocks; ++block) {
    store(sums[block].T, all(S(1)));
    sums[block].alive = drawn_lanes(f, lanes, tx + block % kBlocksX * kBlockW, ty + block / kBlocksX * kBlockH);
    open |= uint64_t(any_lane(sums[block].alive)) << block;
  }
  const S* records[kBatch];
  uint8_t lists[kBlocks][kBatch];
  uint64_t activity[kBatch];
  int64_t e = f.tile_start[tile];
  while (e < end && open) {
    const int n = end - e < kBatch ? int(end - e) : kBatch;
    int count[kBlocks] = {};
    for (int k = 0; k < n; ++k) {
      if (e + k + 8 < end) {
        const S* next = f.records + int64_t(f.entries[e + k + 8].surfel) * f.stride;
        __builtin_prefetch(next);
        __builtin_prefetch(next + 16);
        if (kBlocks > LANES) __builtin_prefetch(f.boxes + f.entries[e + k + 8].surfel);
      }
      const int32_t surfel = f.entries[e + k].surfel;
      records[k] = f.records + int64_t(surfel) * f.stride;
      activity[k] = 0;
      for (uint64_t m = reached_blocks(lanes, records[k], f.boxes + surfel, tx, ty) & open; m; m &= m - 1) {
        const int block = __builtin_ctzll(m);
        lists[block][count[block]++] = uint8_t(k);
      }
    }
    for (uint64_t m = open; m; m &= m - 1) {
      const int block = __builtin_ctzll(m);
      const vf x = load(lanes.x) + S(tx + block % kBlocksX * kBlockW);
      const vf y = load(lanes.y) + S(ty + block / kBlocksX * kBlockH);
      const uint64_t bit = uint64_t(1) << block;
      if (!blend<S, C, X>(f.near, records, lists[block], count[block], x, y, sums[block], activity, bit)) open &= ~bit;
    }
    for (int k = 0; k < n; ++k)
      if (activity[k]) f.activity[f.entries[e + k].slot] = activity[k];
    e += n;
  }
  f.tile_stop[tile] = e;
  store_maps<S, C, X>(f, tx, ty, sums, maps);
}

// What backward keeps of a tile: incoming gradients, transmittance so far (negative where a pixel is not
// drawn or has stopped), R, and with distortion alpha and the moments.
template <class S, int C, int X> struct Replay {
  alignas(64) S g[kBlocks][planes_of(C, X)][LANES], T[kBlocks][LANES], R[kBlocks][LANES];
  alignas(64) S M[kBlocks][X >= 2 ? 3 : 1][LANES];

  void load_tile(const RasterFrame<S>& f, const Lanes<S>& lanes, int tx, int ty, const S* maps, const S* const* v_maps) {
    const int64_t plane = int64_t(f.width) * f.height;
    alignas(64) S sums[kTile][kTile] = {};  // of maps times gradients, by image rows: nothing to rearrange per plane
    const int rows = f.height - ty < kTile ? f.height - ty : kTile, columns = f.width - tx < kTile ? f.width - tx : kTile;
    for (int block = 0; block < kBlocks; ++block) {
      const auto drawn = drawn_lanes(f, lanes, tx + block % kBlocksX * kBlockW, ty + block / kBlocksX * kBlockH);
      store(T[block], select(drawn, all(S(1)), all(S(-1))));
    }
    for (int c = 0; c < planes_of(C, X); ++c) {
      if (!v_maps[c]) {
        for (int block = 0; block < kBlocks; ++block) store(g[block][c], all(S(0)));
        continue;
      }
      load_plane(f, tx, ty, v_maps[c], [&](int block) { return g[block][c]; });
      if (c == C + 2) continue;  // the median's gradient does not pass through weights
      for (int row = 0; row < rows; ++row) {
        const int64_t at = int64_t(ty + row) * f.width + tx;
        const S *map = maps + c * plane + at, *v_map = v_maps[c] + at;
        const S share = c == C + 3 ? S(2) : S(1);
        if (columns == kTile)
          for (int x = 0; x < kTile; x += LANES)
            store(sums[row] + x, load(sums[row] + x) + share * load(map + x) * load(v_map + x));
        else
          for (int x = 0; x < columns; ++x) sums[row][x] += share * map[x] * v_map[x];
      }
    }
    for (int block = 0; block < kBlocks; ++block)
      for (int row = 0; row < kBlockH; ++row)
        __builtin_memcpy(R[block] + row * kBlockW, &sums[block / kBlocksX * kBlockH + row][block % kBlocksX * kBlockW],
                         kBlockW * sizeof(S));
    if (X >= 2) {
      load_plane(f, tx, ty, maps + C * plane, [&](int block) { return M[block][0]; });
      load_plane(f, tx, ty, f.moments, [&](int block) { return M[block][X >= 2 ? 1 : 0]; });
      load_plane(f, tx, ty, f.moments + plane, [&](int block) { return M[block][X >= 2 ? 2 : 0]; });
    }
  }
};

// One surfel in one block: adds to the sums of its gradients. What moves the centre with the ray is linear in
// three sums, L, and joins G after the last block, unless absolute values are wanted pixel by pixel.
template <class S, int C, int X, bool Absolute>
inline __attribute__((always_inline)) void replay(S near, const S* r, typename Simd<S>::vf x, typename Simd<S>::vf y,
                                                  Replay<S, C, X>& t, int block, typename Simd<S>::vf* G,
                                                  typename Simd<S>::vf* L) {
  using vf = typename Simd<S>::vf;
  using vm = typename Simd<S>::vm;
  const Hit<S> h = hit(r, x, y, near);
  const auto& g = t.g[block];
  const vf T = load(t.T[block]);
  vm on = h.visible & less(vf{}, T);
  const vf bump = exp_of(h.rho * S(-0.5)), raw = r[9] * bump, alpha = min_of(raw, all(S(kMaxAlpha)));
  const vf next_T = T - T * alpha;
  const vm full = on & less(next_T, all(S(kMinTransmittance)));
  on = on & ~full;
  const vf w = keep(on, alpha * T);
  store(t.T[block], select(full, -T, select(on, next_T, T)));
  vf D = load(g[C]), gz{};
#pragma GCC unroll 20
  for (int c = 0; c < C; ++c) {
    const vf gc = load(g[c]);
    D += r[kRecordHead + c] * gc;
    G[kGradHead + c] += w * gc;
  }
  if (X >= 1) {
    const vf g_depth = load(g[X >= 1 ? C + 1 : 0]);
    D += h.z * g_depth;
    const vm half = on & less(all(S(0.5)), T) & at_most(next_T, all(S(0.5)));
    gz = w * g_depth + keep(half, load(g[X >= 1 ? C + 2 : 0]));
  }
  if (X >= 2) {
    const vf gd = load(g[X >= 2 ? C + 3 : 0]), iz = reciprocal(h.z), m = near * iz;
    const vf A = load(t.M[block][0]), m1 = load(t.M[block][X >= 2 ? 1 : 0]), m2 = load(t.M[block][X >= 2 ? 2 : 0]);
    D += gd * (m * m * A + m2 - 2 * m * m1);
    gz -= 2 * w * gd * (m * A - m1) * m * iz;
  }
  const vf R = load(t.R[block]) - w * D;
  store(t.R[block], R);
  const vf g_alpha = keep(on & at_most(raw, all(S(kMaxAlpha))), T * D - R * reciprocal(1 - alpha));
  G[9] += g_alpha * bump;
  const vf g_rho = S(-0.5) * g_alpha * alpha;
  const vf on_disc = keep(h.on_disc, g_rho), low_pass = S(2 * kLowPass) * (g_rho - on_disc), scaled = 2 * on_disc * h.iq;
  const vf gpx = h.u * scaled, gpy = h.v * scaled;
  const vf gz_disc = keep(h.has_hit, gz * h.iq);
  G[8] += select(h.has_hit, gz_disc, gz);
  const vf gq = -(h.u * gpx + h.v * gpy) - gz_disc * h.z;
  if (Absolute) {
    const vf gdx = gpx * r[2] + gpy * r[4] + gq * r[6] + h.dx * low_pass;
    const vf gdy = gpx * r[3] + gpy * r[5] + gq * r[7] + h.dy * low_pass;
    G[0] -= gdx;
    G[1] -= gdy;
    G[10] += abs_of(gdx);
    G[11] += abs_of(gdy);
  } else {
    L[0] += gpx;
    L[1] += gpy;
    L[2] += gq;
    G[0] -= h.dx * low_pass;
    G[1] -= h.dy * low_pass;
  }
  G[2] += gpx * h.dx;
  G[3] += gpx * h.dy;
  G[4] += gpy * h.dx;
  G[5] += gpy * h.dy;
  G[6] += gq * h.dx;
  G[7] += gq * h.dy;
}

template <class S, int C, int X, bool Absolute>
void backward_tile(const RasterFrame<S>& f, int tile, const S* maps, const S* const* v_maps, S* slots) {
  using vf = typename Simd<S>::vf;
  static const Lanes<S> lanes;
  constexpr int width = kGradHead + C, ahead = 6;
  const int tx = tile % f.tiles_x * kTile, ty = tile / f.tiles_x * kTile;
  const int64_t begin = f.tile_start[tile], end = f.tile_stop[tile];
  if (begin == end) return;
  Replay<S, C, X> t;
  t.load_tile(f, lanes, tx, ty, maps, v_maps);
  for (int64_t e = begin; e < end; ++e) {
    if (e + 2 * ahead < end) __builtin_prefetch(f.activity + f.entries[e + 2 * ahead].slot);
    if (e + ahead < end && f.activity[f.entries[e + ahead].slot]) {
      const S* next = f.records + int64_t(f.entries[e + ahead].surfel) * f.stride;
      __builtin_prefetch(next);
      __builtin_prefetch(next + 16);
      __builtin_prefetch(slots + int64_t(f.entries[e + ahead].slot) * width, 1);
      __builtin_prefetch(slots + int64_t(f.entries[e + ahead].slot) * width + width - 1, 1);
    }
    uint64_t active = f.activity[f.entries[e].slot];
    if (!active) continue;
    const S* r = f.records + int64_t(f.entries[e].surfel) * f.stride;
    vf L[3] = {};
    vf G[(width + 15) / 16 * 16];
#pragma GCC unroll 32
    for (int c = 0; c < (width + 15) / 16 * 16; ++c) G[c] = vf{};
    for (; active; active &= active - 1) {
      const int block = __builtin_ctzll(active);
      const vf x = load(lanes.x) + S(tx + block % kBlocksX * kBlockW);
      const vf y = load(lanes.y) + S(ty + block / kBlocksX * kBlockH);
      replay<S, C, X, Absolute>(f.near, r, x, y, t, block, G, L);
    }
    G[0] -= r[2] * L[0] + r[4] * L[1] + r[6] * L[2];
    G[1] -= r[3] * L[0] + r[5] * L[1] + r[7] * L[2];
    lane_sums(G, width, slots + int64_t(f.entries[e].slot) * width);
  }
}

template <class S, int C, int X> RasterKernels<S> raster_kernels_of() {
  return {forward_tile<S, C, X>, backward_tile<S, C, X, false>, backward_tile<S, C, X, true>};
}
template <class S, int C> RasterKernels<S> raster_kernels_c(Extra extra) {
  switch (extra) {
    case Extra::none: return raster_kernels_of<S, C, 0>();
    case Extra::depth: return raster_kernels_of<S, C, 1>();
    default: return raster_kernels_of<S, C, 2>();
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
