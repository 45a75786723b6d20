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

template <class T> void fit(std::vector<T>& v, int64_t n) {
  if (int64_t(v.capacity()) < n) {
    v.clear();
    v.reserve(size_t(n + n / 4));
  }
  v.resize(size_t(n));
}

int lanes_of(float) { return kernels().lanes; }
int lanes_of(double) { return 4; }

}  // namespace

template <class S> void Raster<S>::project(const Surfels<S>& in, S* radii) {
  fit(splats_, in.count);
  fit(all_boxes_, in.count);
  parallel_for(in.count, options_.threads, [&](int64_t i) {
    radii[i] = 0;
    all_boxes_[i] = {0, 0, -1, -1};
    const S opacity = in.opacities[i];
    const auto disc = disc_in_camera(in.means + 3 * i, in.quats + 4 * i, in.scales + 2 * i, cam_);
    if (!(disc.P.z > cam_.near) || !(opacity > S(kMinAlpha))) return;
    const auto s = splat(disc, cam_);
    S lo[2], hi[2];
    if (!bounds(disc, cam_, s, S(2) * std::log(opacity / S(kMinAlpha)), lo, hi)) return;
    if (!std::isfinite(s.j00 + s.j01 + s.j10 + s.j11 + s.s0 + s.s1 + lo[0] + hi[0] + lo[1] + hi[1])) return;
    // pixels whose centres lie inside
    const int x0 = int(std::ceil(std::max(lo[0], S(0)) - S(0.5))), y0 = int(std::ceil(std::max(lo[1], S(0)) - S(0.5)));
    const int x1 = int(std::floor(std::min(hi[0], S(cam_.width)) - S(0.5)));
    const int y1 = int(std::floor(std::min(hi[1], S(cam_.height)) - S(0.5)));
    if (x0 > x1 || y0 > y1) return;
    splats_[i] = s;
    all_boxes_[i] = {int16_t(std::max(x0, 0)), int16_t(std::max(y0, 0)), int16_t(x1), int16_t(y1)};
    radii[i] = S(0.5) * std::max(hi[0] - lo[0], hi[1] - lo[1]);
  });
}

// Near to far: a radix sort of the depth's float bits, stable in the surfel's index.
template <class S> void Raster<S>::sort() {
  keys_.clear();
  for (size_t i = 0; i < all_boxes_.size(); ++i) {
    if (all_boxes_[i].x1 < all_boxes_[i].x0) continue;
    const float z = float(splats_[i].z);
    uint32_t bits;
    std::memcpy(&bits, &z, 4);
    keys_.push_back(uint64_t(bits) << 32 | uint32_t(i));
  }
  fit(spare_, int64_t(keys_.size()));
  for (int shift = 32; shift < 64; shift += 11) {
    size_t start[2049] = {};
    for (const uint64_t k : keys_) ++start[(k >> shift & 2047) + 1];
    for (int i = 0; i < 2048; ++i) start[i + 1] += start[i];
    for (const uint64_t k : keys_) spare_[start[k >> shift & 2047]++] = k;
    keys_.swap(spare_);
  }
}

template <class S> void Raster<S>::write_records(const Surfels<S>& in) {
  const int64_t visible = int64_t(keys_.size());
  stride_ = (kRecordHead + channels_ + 15) / 16 * 16;
  fit(records_, visible * stride_);
  fit(boxes_, visible);
  parallel_for(visible, options_.threads, [&](int64_t k) {
    const int64_t i = uint32_t(keys_[k]);
    const Splat<S>& s = splats_[i];
    S* r = records_.data() + k * stride_;
    const S opacity = in.opacities[i];
    const S head[kRecordHead] = {s.x,  s.y,  s.j00, s.j01,   s.j10, s.j11, s.s0,
                                 s.s1, s.z, opacity, S(2) * std::log(opacity / S(kMinAlpha)), S(i)};
    std::copy(head, head + kRecordHead, r);
    std::fill(r + kRecordHead, r + stride_, S(0));
    std::copy(in.features + i * in.channels, in.features + (i + 1) * in.channels, r + kRecordHead);
    if (options_.normals) {
      const auto d = disc_in_camera(in.means + 3 * i, in.quats + 4 * i, in.scales + 2 * i, cam_);
      const S sign = d.flipped ? S(-1) : S(1);
      S* n = r + kRecordHead + in.channels;
      n[0] = sign * d.axes.n.x, n[1] = sign * d.axes.n.y, n[2] = sign * d.axes.n.z;
    }
    boxes_[k] = all_boxes_[i];
  });
}

// Every tile's surfels, near to far, by a counting sort over contiguous shares of the surfels.
template <class S> void Raster<S>::bin() {
  const int64_t visible = int64_t(keys_.size()), tiles = int64_t(tiles_x_) * tiles_y_;
  const int shares = std::max(1, std::min<int>(options_.threads, int(visible / 4096) + 1));
  fit(slot_start_, visible + 1);
  slot_start_[0] = 0;
  for (int64_t k = 0; k < visible; ++k) {
    const Box b = boxes_[k];
    slot_start_[k + 1] = slot_start_[k] + int64_t(b.x1 / kTile - b.x0 / kTile + 1) * (b.y1 / kTile - b.y0 / kTile + 1);
  }
  const int64_t total = slot_start_[visible];
  std::vector<int64_t> position(size_t(shares * tiles), 0);
  const auto each_tile = [&](int share, auto&& visit) {
    for (int64_t k = visible * share / shares; k < visible * (share + 1) / shares; ++k) {
      const Box b = boxes_[k];
      int64_t slot = slot_start_[k];
      for (int y = b.y0 / kTile; y <= b.y1 / kTile; ++y)
        for (int x = b.x0 / kTile; x <= b.x1 / kTile; ++x) visit(int64_t(y) * tiles_x_ + x, k, slot++);
    }
  };
  parallel_for(shares, options_.threads, [&](int64_t p) {
    each_tile(int(p), [&](int64_t tile, int64_t, int64_t) { ++position[p * tiles + tile]; });
  });
  fit(tile_start_, tiles + 1);
  longest_tile_ = 0;
  int64_t sum = 0;
  for (int64_t tile = 0; tile < tiles; ++tile) {
    tile_start_[tile] = sum;
    for (int p = 0; p < shares; ++p) {
      const int64_t n = position[p * tiles + tile];
      position[p * tiles + tile] = sum;
      sum += n;
    }
    longest_tile_ = std::max(longest_tile_, sum - tile_start_[tile]);
  }
  tile_start_[tiles] = sum;
  fit(entries_, total);
  fit(entry_slots_, total);
  fit(activity_, total);
  parallel_for(shares, options_.threads, [&](int64_t p) {
    each_tile(int(p), [&](int64_t tile, int64_t k, int64_t slot) {
      const int64_t e = position[p * tiles + tile]++;
      entries_[e] = int32_t(k);
      entry_slots_[e] = int32_t(slot);
    });
  });
}

template <class S> RasterFrame<S> Raster<S>::frame() {
  return {cam_.width,      cam_.height,       tiles_x_,         tiles_y_,           channels_,
          options_.extra,  cam_.near,         stride_,          records_.data(),    boxes_.data(),
          entries_.data(), entry_slots_.data(), tile_start_.data(), activity_.data(), moments_.data()};
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
  write_records(surfels);
  bin();
  if (options.extra == Extra::distortion) fit(moments_, 2 * int64_t(cam.width) * cam.height);
  const auto draw = tile_kernels(S(0), channels_, options.extra).forward;
  const RasterFrame<S> f = frame();
  const int64_t lists = (kTilePixels / lanes_of(S(0))) * longest_tile_;
  lists_.resize(size_t(std::max(1, options.threads)));
  for (auto& list : lists_) fit(list, lists);
  parallel_for_dynamic(int64_t(tiles_x_) * tiles_y_, options.threads,
                       [&](int64_t tile, int thread) { draw(f, int(tile), lists_[thread].data(), longest_tile_, maps); });
}

template <class S>
void Raster<S>::backward(const Surfels<S>& in, const S* maps, const S* v_maps, const SurfelGrads<S>& out) {
  const int width = kGradHead + channels_;
  fit(slots_, int64_t(entries_.size()) * width);
  const auto replay = tile_kernels(S(0), channels_, options_.extra).backward;
  const RasterFrame<S> f = frame();
  parallel_for_dynamic(int64_t(tiles_x_) * tiles_y_, options_.threads,
                       [&](int64_t tile, int) { replay(f, int(tile), maps, v_maps, slots_.data()); });

  std::fill(out.means, out.means + 3 * in.count, S(0));
  std::fill(out.quats, out.quats + 4 * in.count, S(0));
  std::fill(out.scales, out.scales + 2 * in.count, S(0));
  std::fill(out.opacities, out.opacities + in.count, S(0));
  std::fill(out.features, out.features + in.channels * in.count, S(0));
  std::fill(out.screen, out.screen + 2 * in.count, S(0));
  const int64_t visible = int64_t(keys_.size()), chunks = (visible + kChunk - 1) / kChunk;
  std::vector<double> pose(size_t(chunks) * 12, 0.0);
  parallel_for(chunks, options_.threads, [&](int64_t chunk) {
    double* v_pose = pose.data() + chunk * 12;
    for (int64_t k = chunk * kChunk; k < std::min(visible, (chunk + 1) * kChunk); ++k) {
      const int64_t i = uint32_t(keys_[k]);
      S g[kGradHead + kMaxChannels] = {};
      for (int64_t slot = slot_start_[k]; slot < slot_start_[k + 1]; ++slot)
        for (int c = 0; c < width; ++c) g[c] += slots_[slot * width + c];
      const S *mean = in.means + 3 * i, *quat = in.quats + 4 * i, *scale = in.scales + 2 * i;
      const auto disc = disc_in_camera(mean, quat, scale, cam_);
      const Splat<S> gs{g[0], g[1], g[2], g[3], g[4], g[5], g[6], g[7], g[8]};
      const auto gd = splat_vjp(disc, cam_, splats_[i], gs);
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
      out.opacities[i] = g[9];
      out.screen[2 * i] = std::sqrt(g[0] * g[0] + g[1] * g[1]);
      out.screen[2 * i + 1] = std::sqrt(g[10] * g[10] + g[11] * g[11]);
      std::copy(g + kGradHead, g + kGradHead + in.channels, out.features + i * in.channels);
      const Vec3<S> tu = disc.su * disc.axes.u, tv = disc.sv * disc.axes.v;
      const S gp[3] = {gd.P.x, gd.P.y, gd.P.z}, gu[3] = {gd.U.x, gd.U.y, gd.U.z}, gv[3] = {gd.V.x, gd.V.y, gd.V.z};
      for (int row = 0; row < 3; ++row) {
        v_pose[4 * row] += gp[row] * mean[0] + gu[row] * tu.x + gv[row] * tv.x;
        v_pose[4 * row + 1] += gp[row] * mean[1] + gu[row] * tu.y + gv[row] * tv.y;
        v_pose[4 * row + 2] += gp[row] * mean[2] + gu[row] * tu.z + gv[row] * tv.z;
        v_pose[4 * row + 3] += gp[row];
      }
    }
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
