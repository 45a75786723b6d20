#include "rasterize.h"

#include <algorithm>
#include <cmath>
#include <cstring>

#include "dispatch.h"
#include "parallel.h"

namespace refdgs {

namespace {

constexpr int kChunk = 2048;  // surfels whose pose gradients are summed together, whatever the threads

RasterKernels<float> tile_kernels(float, int channels, Extra extra) { return kernels().raster(channels, extra); }
RasterKernels<double> tile_kernels(double, int channels, Extra extra) {
  return raster_kernels_double(channels, extra);
}

template <class T, class A> void fit(std::vector<T, A>& v, int64_t n) {
  if (int64_t(v.capacity()) < n) {
    v.clear();
    v.reserve(size_t(n + n / 4));
  }
  v.resize(size_t(n));
}

int64_t tiles_of(const Box& b) {
  return b.x1 < b.x0 ? 0 : int64_t(b.x1 / kTile - b.x0 / kTile + 1) * (b.y1 / kTile - b.y0 / kTile + 1);
}

// The ellipse of record scalars kContour.. that holds all pixels with squared radius below `cut`, a
// little larger to be safe; zeros if it is no ellipse or has no usable inverse.
template <class S>
void contour(const Disc<S>& d, const Pinhole<S>& cam, const Splat<S>& s, S cut, S* out) {
  for (int c = 0; c < 7; ++c) out[c] = 0;
  const S delta = cut * (d.U.z * d.U.z + d.V.z * d.V.z) - s.z * s.z;
  if (!(delta < -S(1e-6) * s.z * s.z)) return;  // the disc reaches the camera's plane
  const Tangents<S> t = tangents(d, cam);
  const S f = cut / delta;
  const S mx = f * (t.a * d.U.z + t.b * d.V.z), my = f * (t.c * d.U.z + t.e * d.V.z);
  S xx = std::max(mx * mx - f * (t.a * t.a + t.b * t.b), S(0));
  S yy = std::max(my * my - f * (t.c * t.c + t.e * t.e), S(0));
  const S xy = mx * my - f * (t.a * t.c + t.b * t.e), more = S(0.01) + S(1e-4) * (xx + yy);
  xx += more, yy += more;
  const S det = xx * yy - xy * xy;
  if (!(det > 0) || !std::isfinite(det)) return;
  const S k = 1 / det;
  const S ellipse[7] = {s.x + mx, s.y + my, yy * k, -2 * xy * k, xx * k, xy / xx, xy / yy};
  std::copy(ellipse, ellipse + 7, out);
}

}  // namespace

template <class S>
void Raster<S>::write_record(const Surfels<S>& in, int64_t i, const Disc<S>& disc, const Splat<S>& s, S cut) {
  S* r = records_.data() + i * stride_;
  const S head[kContour] = {s.x, s.y, s.j00, s.j01, s.j10, s.j11, s.s0, s.s1, s.z, in.opacities[i], cut, S(0)};
  std::copy(head, head + kContour, r);
  contour(disc, cam_, s, cut, r + kContour);
  r[kRecordHead - 1] = 0;
  S* channel = r + kRecordHead;
  for (int c = 0; c < in.channels; ++c) *channel++ = in.features[i * in.channels + c];
  if (options_.normals) {
    const S sign = disc.flipped ? S(-1) : S(1);
    *channel++ = sign * disc.axes.n.x, *channel++ = sign * disc.axes.n.y, *channel++ = sign * disc.axes.n.z;
  }
  while (channel < r + kRecordHead + channels_) *channel++ = S(0);
}

template <class S> void Raster<S>::project(const Surfels<S>& in, S* radii) {
  stride_ = (kRecordHead + channels_ + 15) / 16 * 16;
  fit(records_, in.count * stride_);
  fit(boxes_, in.count);
  fit(depths_, in.count);
  parallel_for(in.count, options_.threads, [&](int64_t i) {
    radii[i] = 0;
    boxes_[i] = {0, 0, -1, -1};
    const S opacity = in.opacities[i];
    const auto disc = disc_in_camera(in.means + 3 * i, in.quats + 4 * i, in.scales + 2 * i, cam_);
    if (!(disc.P.z > cam_.near) || !(opacity > S(kMinAlpha))) return;
    const auto s = splat(disc, cam_);
    const S cut = S(2) * std::log(opacity / S(kMinAlpha));
    S lo[2], hi[2];
    if (!bounds(disc, cam_, s, cut, lo, hi)) return;
    if (!std::isfinite(s.j00 + s.j01 + s.j10 + s.j11 + s.s0 + s.s1 + lo[0] + hi[0] + lo[1] + hi[1])) return;
    // pixels whose centres lie inside
    const int x0 = int(std::ceil(std::max(lo[0], S(0)) - S(0.5))), y0 = int(std::ceil(std::max(lo[1], S(0)) - S(0.5)));
    const int x1 = int(std::floor(std::min(hi[0], S(cam_.width)) - S(0.5)));
    const int y1 = int(std::floor(std::min(hi[1], S(cam_.height)) - S(0.5)));
    if (x0 > x1 || y0 > y1) return;
    boxes_[i] = {int16_t(std::max(x0, 0)), int16_t(std::max(y0, 0)), int16_t(x1), int16_t(y1)};
    radii[i] = S(0.5) * std::max(hi[0] - lo[0], hi[1] - lo[1]);
    const float z = float(s.z);
    std::memcpy(&depths_[i], &z, 4);
    write_record(in, i, disc, s, cut);
  });
}

// Near to far: a radix sort of the depth's float bits, stable in the surfel's index. Numbers the slots
// on the way, in the order of the surfels.
template <class S> void Raster<S>::sort() {
  const int64_t count = int64_t(boxes_.size());
  fit(slot_start_, count + 1);
  slot_start_[0] = 0;
  fit(keys_, count);
  size_t drawn = 0;
  for (int64_t i = 0; i < count; ++i) {
    const int64_t tiles = tiles_of(boxes_[i]);
    slot_start_[i + 1] = slot_start_[i] + tiles;
    keys_[drawn] = uint64_t(depths_[i]) << 32 | uint32_t(i);
    drawn += tiles > 0;
  }
  keys_.resize(drawn);
  fit(spare_, int64_t(drawn));
  for (int shift = 32; shift < 64; shift += 11) {
    size_t start[2049] = {};
    for (const uint64_t k : keys_) ++start[(k >> shift & 2047) + 1];
    for (int i = 0; i < 2048; ++i) start[i + 1] += start[i];
    for (const uint64_t k : keys_) spare_[start[k >> shift & 2047]++] = k;
    keys_.swap(spare_);
  }
}

// Every tile's surfels, near to far, by a counting sort over contiguous shares of the surfels.
template <class S> void Raster<S>::bin() {
  const int64_t visible = int64_t(keys_.size()), tiles = int64_t(tiles_x_) * tiles_y_;
  const int shares = std::max(1, std::min<int>(options_.threads, int(visible / 4096) + 1));
  const int64_t total = slot_start_.back();
  std::vector<int64_t> position(size_t(shares * tiles), 0);
  const auto each_tile = [&](int share, auto&& visit) {
    for (int64_t k = visible * share / shares; k < visible * (share + 1) / shares; ++k) {
      const int64_t i = uint32_t(keys_[k]);
      const Box b = boxes_[i];
      if (k + 16 < visible) {
        __builtin_prefetch(&boxes_[uint32_t(keys_[k + 16])]);
        __builtin_prefetch(&slot_start_[uint32_t(keys_[k + 16])]);
      }
      int64_t slot = slot_start_[i];
      for (int y = b.y0 / kTile; y <= b.y1 / kTile; ++y)
        for (int x = b.x0 / kTile; x <= b.x1 / kTile; ++x) visit(int64_t(y) * tiles_x_ + x, i, slot++);
    }
  };
  parallel_for(shares, options_.threads, [&](int64_t p) {
    each_tile(int(p), [&](int64_t tile, int64_t, int64_t) { ++position[p * tiles + tile]; });
  });
  fit(tile_start_, tiles + 1);
  int64_t sum = 0;
  for (int64_t tile = 0; tile < tiles; ++tile) {
    tile_start_[tile] = sum;
    for (int p = 0; p < shares; ++p) {
      const int64_t n = position[p * tiles + tile];
      position[p * tiles + tile] = sum;
      sum += n;
    }
  }
  tile_start_[tiles] = sum;
  fit(entries_, total);
  fit(tile_stop_, tiles);
  fit(activity_, total);
  std::fill(activity_.begin(), activity_.end(), uint64_t(0));
  parallel_for(shares, options_.threads, [&](int64_t p) {
    each_tile(int(p), [&](int64_t tile, int64_t i, int64_t slot) {
      const int64_t e = position[p * tiles + tile]++;
      entries_[e] = {int32_t(i), int32_t(slot)};
    });
  });
}

template <class S> RasterFrame<S> Raster<S>::frame() {
  return {cam_.width,       cam_.height,        tiles_x_,           tiles_y_,          channels_,
          options_.extra,   cam_.near,          stride_,            records_.data(),   boxes_.data(),
          entries_.data(),  tile_start_.data(), tile_stop_.data(), activity_.data(),
          moments_.data()};
}

template <class S>
void Raster<S>::forward(const Surfels<S>& surfels, const Pinhole<S>& cam, const RasterOptions& options, S* maps,
                        S* radii) {
  cam_ = cam;
  options_ = options;
  channels_ = padded(surfels.channels, options.normals);
  tiles_x_ = (cam.width + kTile - 1) / kTile;
  tiles_y_ = (cam.height + kTile - 1) / kTile;
  project(surfels, radii);
  sort();
  bin();
  if (options.extra == Extra::distortion) fit(moments_, 2 * int64_t(cam.width) * cam.height);
  const auto draw = tile_kernels(S(0), channels_, options.extra).forward;
  const RasterFrame<S> f = frame();
  parallel_for_dynamic(int64_t(tiles_x_) * tiles_y_, options.threads,
                       [&](int64_t tile, int) { draw(f, int(tile), maps); });
}

// One surfel: sum its slots, and on to its parameters and the pose.
template <class S>
void Raster<S>::reduce(const Surfels<S>& in, const SurfelGrads<S>& out, int64_t i, double* v_pose) const {
  const int width = kGradHead + channels_;
  alignas(64) S g[kGradHead + kMaxChannels] = {};
  bool any = false;
  for (int64_t slot = slot_start_[i]; slot < slot_start_[i + 1]; ++slot) {
    if (!activity_[slot]) continue;
    any = true;
    const S* from = slots_.data() + slot * width;
    for (int c = 0; c < width; c += 4)
      for (int k = 0; k < 4; ++k) g[c + k] += from[c + k];
  }
  std::copy(g + kGradHead, g + kGradHead + in.channels, out.features + i * in.channels);
  out.opacities[i] = g[9];
  out.screen[2 * i] = std::sqrt(g[0] * g[0] + g[1] * g[1]);
  out.screen[2 * i + 1] = std::sqrt(g[10] * g[10] + g[11] * g[11]);
  if (!any) {
    std::fill(out.means + 3 * i, out.means + 3 * i + 3, S(0));
    std::fill(out.quats + 4 * i, out.quats + 4 * i + 4, S(0));
    std::fill(out.scales + 2 * i, out.scales + 2 * i + 2, S(0));
    return;
  }
  const S *mean = in.means + 3 * i, *quat = in.quats + 4 * i, *scale = in.scales + 2 * i;
  const S* r = records_.data() + i * stride_;
  const auto disc = disc_in_camera(mean, quat, scale, cam_);
  const Splat<S> s{r[0], r[1], r[2], r[3], r[4], r[5], r[6], r[7], r[8]};
  const Splat<S> gs{g[0], g[1], g[2], g[3], g[4], g[5], g[6], g[7], g[8]};
  const auto gd = splat_vjp(disc, cam_, s, gs);
  const auto g_mean = mul_transposed(cam_.R, gd.P);
  const auto gU = mul_transposed(cam_.R, gd.U), gV = mul_transposed(cam_.R, gd.V);
  out.means[3 * i] = g_mean.x, out.means[3 * i + 1] = g_mean.y, out.means[3 * i + 2] = g_mean.z;
  out.scales[2 * i] = dot(gU, disc.axes.u), out.scales[2 * i + 1] = dot(gV, disc.axes.v);
  Frame3<S> g_axes{disc.su * gU, disc.sv * gV, {0, 0, 0}};
  if (options_.normals) {
    const S sign = disc.flipped ? S(-1) : S(1);
    const S* n = g + kGradHead + in.channels;
    g_axes.n = {sign * n[0], sign * n[1], sign * n[2]};
  }
  rotation_vjp(quat, g_axes, out.quats + 4 * i);
  const Vec3<S> tu = disc.su * disc.axes.u, tv = disc.sv * disc.axes.v;
  const S gp[3] = {gd.P.x, gd.P.y, gd.P.z}, gu[3] = {gd.U.x, gd.U.y, gd.U.z}, gv[3] = {gd.V.x, gd.V.y, gd.V.z};
  for (int row = 0; row < 3; ++row) {
    v_pose[4 * row] += gp[row] * mean[0] + gu[row] * tu.x + gv[row] * tv.x;
    v_pose[4 * row + 1] += gp[row] * mean[1] + gu[row] * tu.y + gv[row] * tv.y;
    v_pose[4 * row + 2] += gp[row] * mean[2] + gu[row] * tu.z + gv[row] * tv.z;
    v_pose[4 * row + 3] += gp[row];
  }
}

template <class S>
void Raster<S>::backward(const Surfels<S>& in, const S* maps, const S* const* v_maps, const SurfelGrads<S>& out) {
  fit(slots_, int64_t(entries_.size()) * (kGradHead + channels_));
  const auto replay = tile_kernels(S(0), channels_, options_.extra).backward;
  const RasterFrame<S> f = frame();
  parallel_for_dynamic(int64_t(tiles_x_) * tiles_y_, options_.threads,
                       [&](int64_t tile, int) { replay(f, int(tile), maps, v_maps, slots_.data()); });
  const int64_t chunks = (in.count + kChunk - 1) / kChunk;
  std::vector<double> pose(size_t(chunks) * 12, 0.0);
  parallel_for(chunks, options_.threads, [&](int64_t chunk) {
    double v_pose[12] = {};
    for (int64_t i = chunk * kChunk; i < std::min(in.count, (chunk + 1) * kChunk); ++i) reduce(in, out, i, v_pose);
    std::copy(v_pose, v_pose + 12, pose.data() + chunk * 12);
  });
  if (!out.cam_from_world) return;
  for (int c = 0; c < 12; ++c) {
    double sum = 0;
    for (int64_t chunk = 0; chunk < chunks; ++chunk) sum += pose[chunk * 12 + c];
    out.cam_from_world[c] = S(sum);
  }
}

template class Raster<float>;
template class Raster<double>;

}  // namespace refdgs
