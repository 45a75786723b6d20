// The epilogue of a pixel, a thread each: what the shader is given, the composite, and normals against depth. Bound by
// memory; some 100 flop a pixel. At 800 x 800, 320,000 of the pixels covered, at 4.3 TB/s:
//   covered pixels   4 + 4 bytes in a pixel, 8 out a covered one: 8 MB, 2 us
//   gather           44 + 16 bytes in, 32 + 16 out a covered pixel: 35 MB, 8 us; back the same and 44 MB cleared: 19 us
//   composite        20 in, 12 out a pixel, 36 in and 24 read and written a covered one: 40 MB, 9 us; back 14 us
//   normal agreement 20 in, 36 out, then 24 + 8 in, 8 out a pixel: 61 MB, 14 us
#pragma once
#include "../math/shade.h"
#include "grid.h"
#include "raster_sums.h"
#include "shade.h"

namespace refdgs::cuda {

template <class S> REFDGS_KERNEL S pixel_of(const Image<S>& image, int64_t y, int64_t x, int c) {
  return image.data[y * image.row + x * image.column + c * image.channel];
}
template <class S> REFDGS_KERNEL Vec3<S> three_of(const Image<S>& image, int64_t y, int64_t x) {
  return {pixel_of(image, y, x, 0), pixel_of(image, y, x, 1), pixel_of(image, y, x, 2)};
}
template <class S> REFDGS_KERNEL S& row_of(const Rows<S>& rows, int64_t i, int c) {
  return rows.data[i * rows.row + c * rows.column];
}
template <class S> REFDGS_KERNEL Vec3<S> ray_of(const View<S>& view, int64_t y, int64_t x) {  // camera, z = 1
  return {(S(x) + S(0.5) - view.cx) / view.fx, (S(y) + S(0.5) - view.cy) / view.fy, S(1)};
}
template <class S>
REFDGS_KERNEL Mirror<S> mirror_of(const View<S>& view, const Image<S>& normal, int64_t y, int64_t x) {
  const Vec3<S> r = ray_of(view, y, x);
  return {rotate(view.world_from_cam, (1 / std::sqrt(dot(r, r))) * r), three_of(normal, y, x)};
}

// How many pixels of a block are covered; of the block past the last, none.
template <class S> struct CountCovered {
  static constexpr int kThreads = kCoveredThreads, kWarps = kThreads / kWarp;
  struct Shared {
    int counts[kWarps];
  };
  CoveredCall<S> f;

  template <class Thread> REFDGS_KERNEL static bool is_covered(Thread& t, const CoveredCall<S>& f) {
    const int64_t p = int64_t(t.block()) * kThreads + t.thread();
    return p < f.plane() && pixel_of(f.alpha, p / f.width, p % f.width, 0) > f.least;
  }
  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared& s) const {
    const uint32_t covered = t.ballot(is_covered(t, f));
    if (t.lane() == 0) s.counts[t.warp()] = bit_count(covered);
    t.sync();
    if (t.thread()) return;
    int64_t sum = 0;
    for (int w = 0; w < kWarps; ++w) sum += s.counts[w];
    f.counts[t.block()] = sum;
  }
};

// Then every thread writes its pixel where it is covered, and the place of its number in the list where none comes.
template <class S> struct WriteCovered {
  static constexpr int kThreads = kCoveredThreads, kWarps = kThreads / kWarp;
  using Shared = typename CountCovered<S>::Shared;
  CoveredCall<S> f;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared& s) const {
    const bool mine = CountCovered<S>::is_covered(t, f);
    const uint32_t covered = t.ballot(mine);
    if (t.lane() == 0) s.counts[t.warp()] = bit_count(covered);
    t.sync();
    int64_t at = f.counts[t.block()] + bit_count(covered & ((1u << t.lane()) - 1));
    for (int w = 0; w < t.warp(); ++w) at += s.counts[w];
    const int64_t i = int64_t(t.block()) * kThreads + t.thread(), needed = f.counts[f.blocks()];
    if (mine && at < f.room) f.pixels[at] = i;
    if (i == 0) {
      *f.needed = needed;
      if (needed > f.room) *f.misfit = 1;
    }
    for (int64_t k = i; k < f.room; k += f.blocks() * kThreads)
      if (k >= needed) f.pixels[k] = -1;
  }
};

template <class S> struct GatherInputs {
  static constexpr int kThreads = 256;
  using Shared = Nothing;
  Covered<S> at;
  const S* lens;
  Inputs<S> out;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared&) const {
    const int64_t i = int64_t(t.block()) * kThreads + t.thread();
    if (i >= at.count) return;
    if (at.pixels[i] < 0) return nowhere(i);
    const int64_t y = at.pixels[i] / at.view.width, x = at.pixels[i] % at.view.width;
    const S whole = 1 / pixel_of(at.alpha, y, x, 0);
    for (int c = 0; c < 3; ++c) row_of(out.diffuse, i, c) = pixel_of(at.features, y, x, c) * whole;
    row_of(out.roughness, i, 0) = pixel_of(at.features, y, x, 3) * whole;
    const Mirror<S> mirror = mirror_of(seen_through(lens, at.view), at.normal, y, x);
    const Vec3<S> to = mirror.out.unit;
    row_of(out.reflected, i, 0) = to.x, row_of(out.reflected, i, 1) = to.y, row_of(out.reflected, i, 2) = to.z;
    row_of(out.cosine, i, 0) = mirror.cosine();
    if (at.near.data)
      for (int c = 0; c < 4; ++c) row_of(out.near, i, c) = pixel_of(at.near, y, x, c);
  }

  // Numbers that harm nothing, where there is no pixel.
  REFDGS_KERNEL void nowhere(int64_t i) const {
    for (int c = 0; c < 3; ++c) row_of(out.diffuse, i, c) = 0, row_of(out.reflected, i, c) = S(c == 2);
    row_of(out.roughness, i, 0) = 1, row_of(out.cosine, i, 0) = 0;
    if (at.near.data)
      for (int c = 0; c < 4; ++c) row_of(out.near, i, c) = 0;
  }
};

template <class S> struct GatherInputsBwd {
  static constexpr int kThreads = 256;
  using Shared = Nothing;
  Covered<S> at;
  const S* lens;
  Inputs<const S> v;
  MapGrads<S> grads;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared&) const {
    const int64_t i = int64_t(t.block()) * kThreads + t.thread();
    if (i >= at.count) return;
    const int64_t plane = int64_t(at.view.width) * at.view.height, p = at.pixels[i];
    if (p < 0) return;
    const int64_t y = p / at.view.width, x = p % at.view.width;
    const S whole = 1 / pixel_of(at.alpha, y, x, 0);
    S v_alpha = 0;
    for (int c = 0; c < 4; ++c) {
      const S g = (c < 3 ? row_of(v.diffuse, i, c) : row_of(v.roughness, i, 0)) * whole;
      grads.features[c * plane + p] = g;
      v_alpha -= g * pixel_of(at.features, y, x, c) * whole;
    }
    grads.alpha[p] = v_alpha;
    const Vec3<S> v_out{row_of(v.reflected, i, 0), row_of(v.reflected, i, 1), row_of(v.reflected, i, 2)};
    const Mirror<S> mirror = mirror_of(seen_through(lens, at.view), at.normal, y, x);
    const Vec3<S> n = mirror.vjp(v_out, row_of(v.cosine, i, 0));
    grads.normal[p] = n.x, grads.normal[plane + p] = n.y, grads.normal[2 * plane + p] = n.z;
    if (at.near.data)
      for (int c = 0; c < 4; ++c) grads.near[c * plane + p] = row_of(v.near, i, c);
  }
};

// Every pixel: what lies behind the object.
template <class S> struct ComposeBehind {
  static constexpr int kThreads = 256;
  using Shared = Nothing;
  Composite<S> in;
  const S* backdrop;
  S* image;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared&) const {
    const int64_t plane = int64_t(in.width) * in.height, p = int64_t(t.block()) * kThreads + t.thread();
    if (p >= plane) return;
    const int64_t y = p / in.width, x = p % in.width;
    const S open = 1 - pixel_of(in.alpha, y, x, 0);
    for (int c = 0; c < 3; ++c)
      image[c * plane + p] = open * backdrop[c] + (in.behind.data ? pixel_of(in.behind, y, x, c) : S(0));
  }
};

// Then covered pixels: the object.
template <class S> struct ComposeObject {
  static constexpr int kThreads = 256;
  using Shared = Nothing;
  Composite<S> in;
  S* image;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared&) const {
    const int64_t i = int64_t(t.block()) * kThreads + t.thread();
    if (i >= in.count) return;
    const int64_t plane = int64_t(in.width) * in.height, p = in.pixels[i];
    if (p < 0) return;
    const S a = pixel_of(in.object_alpha, p / in.width, p % in.width, 0);
    for (int c = 0; c < 3; ++c)
      image[c * plane + p] += a * Shown<S>(row_of(in.diffuse, i, c) + row_of(in.radiance, i, c)).color;
  }
};

template <class S> struct ComposeBehindBwd {
  static constexpr int kThreads = 256;
  using Shared = Nothing;
  Composite<S> in;
  const S* backdrop;
  Image<S> v_image;
  S *v_object_alpha, *v_alpha;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared&) const {
    const int64_t p = int64_t(t.block()) * kThreads + t.thread();
    if (p >= int64_t(in.width) * in.height) return;
    S sum = 0;
    for (int c = 0; c < 3; ++c) sum -= pixel_of(v_image, p / in.width, p % in.width, c) * backdrop[c];
    v_alpha[p] = sum;
    if (v_object_alpha != v_alpha) v_object_alpha[p] = 0;
  }
};

template <class S> struct ComposeObjectBwd {
  static constexpr int kThreads = 256;
  using Shared = Nothing;
  Composite<S> in;
  Image<S> v_image;
  S *v_linear, *v_object_alpha;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared&) const {
    const int64_t i = int64_t(t.block()) * kThreads + t.thread();
    if (i >= in.count) return;
    const int64_t p = in.pixels[i], y = p / in.width, x = p % in.width;
    if (p < 0) {
      for (int c = 0; c < 3; ++c) v_linear[3 * i + c] = 0;
      return;
    }
    const S a = pixel_of(in.object_alpha, y, x, 0);
    S v_a = 0;
    for (int c = 0; c < 3; ++c) {
      const Shown<S> shown(row_of(in.diffuse, i, c) + row_of(in.radiance, i, c));
      const S v = pixel_of(v_image, y, x, c);
      v_a += v * shown.color;
      v_linear[3 * i + c] = shown.vjp(a * v);
    }
    v_object_alpha[p] += v_a;
  }
};

// Every pixel: its part of the sum, and the gradients by its neighbours' points and its normal.
template <class S> struct AgreeNormals {
  static constexpr int kThreads = kAgreementThreads, kWarps = kThreads / kWarp;
  struct Shared {
    S sums[kWarps];
  };
  Agreement<S> in;
  const S* lens;
  S *slopes, *parts;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared& s) const {
    const int64_t width = in.view.width, height = in.view.height, plane = width * height;
    const int64_t p = int64_t(t.block()) * kThreads + t.thread();
    S sum = 0;
    if (p < plane) sum = agree(p / width, p % width, plane);
    const S total = sum_lanes<1>(t, &sum);
    if (t.lane() == 0) s.sums[t.warp()] = total;
    t.sync();
    if (t.thread()) return;
    sum = 0;
    for (int w = 0; w < kWarps; ++w) sum += s.sums[w];
    parts[t.block()] = sum;
  }

  REFDGS_KERNEL Vec3<S> point(const View<S>& view, int64_t y, int64_t x) const {
    const S a = pixel_of(in.alpha, y, x, 0);
    return (pixel_of(in.depth, y, x, 0) / (a < S(1e-6) ? S(1e-6) : a)) * ray_of(view, y, x);
  }

  REFDGS_KERNEL S agree(int64_t y, int64_t x, int64_t plane) const {
    const int64_t p = y * in.view.width + x;
    const S weight = pixel_of(in.alpha, y, x, 0);
    const bool border = y == 0 || x == 0 || y == in.view.height - 1 || x == in.view.width - 1;
    S parts_of[6] = {}, sum = 0;
    Vec3<S> v_normal{0, 0, 0};
    if (!border && weight != 0) {
      const View<S> view = seen_through(lens, in.view);
      const Vec3<S> above = point(view, y - 1, x), below = point(view, y + 1, x);
      const Vec3<S> left = point(view, y, x - 1), next = point(view, y, x + 1);
      const S here = point(view, y, x).z;
      if (bend_of<S>(above.z, below.z, left.z, next.z, here) * view.fx < in.edge * here) {
        const Vec3<S> splatted = three_of(in.normal, y, x);
        const NormalPair<S> pair(below - above, next - left, splatted, view.world_from_cam, -in.scale * weight);
        sum = in.scale * weight * (1 - pair.agreement);
        parts_of[0] = pair.v_down.x, parts_of[1] = pair.v_down.y, parts_of[2] = pair.v_down.z;
        parts_of[3] = pair.v_right.x, parts_of[4] = pair.v_right.y, parts_of[5] = pair.v_right.z;
        v_normal = pair.v_normal;
      }
    }
    if (!slopes) return sum;
    for (int k = 0; k < 6; ++k) slopes[k * plane + p] = parts_of[k];
    in.v_normal[p] = v_normal.x, in.v_normal[plane + p] = v_normal.y, in.v_normal[2 * plane + p] = v_normal.z;
    return sum;
  }
};

// Then every pixel gathers what its four neighbours want of its point.
template <class S> struct AgreeNormalsBwd {
  static constexpr int kThreads = 256;
  using Shared = Nothing;
  Agreement<S> in;
  const S *lens, *slopes;

  template <class Thread> REFDGS_KERNEL void operator()(Thread& t, Shared&) const {
    const int64_t width = in.view.width, height = in.view.height, plane = width * height;
    const int64_t p = int64_t(t.block()) * kThreads + t.thread(), y = p / width, x = p % width;
    if (p >= plane) return;
    const auto part = [&](int64_t yy, int64_t xx, int first) -> Vec3<S> {
      if (yy < 0 || xx < 0 || yy >= height || xx >= width) return {0, 0, 0};
      const S* from = slopes + first * plane + yy * width + xx;
      return {from[0], from[plane], from[2 * plane]};
    };
    const Vec3<S> v = part(y - 1, x, 0) - part(y + 1, x, 0) + part(y, x - 1, 3) - part(y, x + 1, 3);
    const S v_z = dot(v, ray_of(seen_through(lens, in.view), y, x));
    const S a = pixel_of(in.alpha, y, x, 0), z = pixel_of(in.depth, y, x, 0);
    const S divisor = a < S(1e-6) ? S(1e-6) : a;
    in.v_depth[p] = v_z / divisor;
    in.v_alpha[p] = a < S(1e-6) ? S(0) : -v_z * z / (divisor * divisor);
  }
};

}  // namespace refdgs::cuda
