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

}  // namespace

template <class S> void Raster<S>::project(const Surfels<S>& in, S* radii) {
  stride_ = (kRecordHead + channels_ + 15) / 16 * 16;
  fit(records_, in.count * stride_);
  fit(boxes_, in.count);
  fit(depths_, in.count);
  parallel_for(in.count, options_.threads, [&](int64_t i) {
    const auto p = refdgs::project(in.means + 3 * i, in.quats + 4 * i, in.scales + 2 * i, in.opacities[i], cam_);
    radii[i] = p.radius;
    boxes_[i] = p.box;
    if (p.box.x1 < p.box.x0) return;
    const float z = float(p.splat.z);
    std::memcpy(&depths_[i], &z, 4);
    refdgs::write_record(p, cam_, in.opacities[i], in.features + i * in.channels, in.channels, options_.normals,
                         channels_, records_.data() + i * stride_);
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
          moments_.data(),  options_.needed};
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
  const auto v = record_vjp(in.means + 3 * i, in.quats + 4 * i, in.scales + 2 * i, cam_, records_.data() + i * stride_,
                            g, options_.normals ? g + kGradHead + in.channels : nullptr);
  std::copy(v.mean, v.mean + 3, out.means + 3 * i);
  std::copy(v.quat, v.quat + 4, out.quats + 4 * i);
  std::copy(v.scale, v.scale + 2, out.scales + 2 * i);
  for (int c = 0; c < 12; ++c) v_pose[c] += v.v_pose[c];
}

template <class S>
void Raster<S>::backward(const Surfels<S>& in, const S* maps, const S* const* v_maps, const SurfelGrads<S>& out) {
  fit(slots_, int64_t(entries_.size()) * (kGradHead + channels_));
  const RasterKernels<S> kernels = tile_kernels(S(0), channels_, options_.extra);
  const auto replay = options_.absolute ? kernels.backward_absolute : kernels.backward;
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
