#include "shade.h"

#include <cmath>
#include <vector>

#include "parallel.h"

namespace refdgs {

namespace {

constexpr int64_t kBlock = 4096;  // covered pixels of one task

template <class S> S element(const Image<S>& image, int64_t y, int64_t x, int64_t c) {
  return image.data[y * image.row + x * image.column + c * image.channel];
}

template <class S> Vec3<S> three(const Image<S>& image, int64_t y, int64_t x) {
  return {element(image, y, x, 0), element(image, y, x, 1), element(image, y, x, 2)};
}

// v / sqrt(|v|^2 + eps) and its backward pass.
template <class S> struct Unit {
  Vec3<S> v, unit;
  S scale;
  Unit(Vec3<S> a, S eps) : v(a), scale(1 / std::sqrt(dot(a, a) + eps)) { unit = scale * a; }
  Vec3<S> backward(Vec3<S> g) const { return scale * g - (scale * scale * scale * dot(v, g)) * v; }
};

template <class S> Vec3<S> pixel_ray(const View<S>& view, int64_t y, int64_t x) {  // z = 1
  return {(S(x) + S(0.5) - view.cx) / view.fx, (S(y) + S(0.5) - view.cy) / view.fy, S(1)};
}

// The mirror at one pixel: the ray, the surface's normal, where the ray goes.
template <class S> struct Mirror {
  Vec3<S> ray;
  Unit<S> normal;
  S towards;
  Unit<S> out;
  Mirror(const View<S>& view, const Image<S>& normals, int64_t y, int64_t x)
      : ray(world_ray(view, y, x)), normal(three(normals, y, x), S(1e-16)), towards(-dot(normal.unit, ray)),
        out(ray + (2 * towards) * normal.unit, S(1e-16)) {}
  static Vec3<S> world_ray(const View<S>& view, int64_t y, int64_t x) {
    const Vec3<S> r = pixel_ray(view, y, x);
    return mul(view.world_from_cam, (1 / std::sqrt(dot(r, r))) * r);
  }
};

template <class F> void over_blocks(int64_t count, int threads, F&& body) {
  parallel_for((count + kBlock - 1) / kBlock, threads, [&](int64_t block) {
    const int64_t end = block * kBlock + kBlock < count ? block * kBlock + kBlock : count;
    for (int64_t i = block * kBlock; i < end; ++i) body(i);
  });
}

}  // namespace

template <class S> void shading_inputs(const Covered<S>& at, int threads, const Inputs<S>& out) {
  over_blocks(at.count, threads, [&](int64_t i) {
    const int64_t y = at.pixels[i] / at.view.width, x = at.pixels[i] % at.view.width;
    const S whole = 1 / element(at.alpha, y, x, 0);
    for (int c = 0; c < 4; ++c) out.carried[4 * i + c] = element(at.features, y, x, c) * whole;
    const Mirror<S> mirror(at.view, at.normal, y, x);
    out.reflected[3 * i] = mirror.out.unit.x;
    out.reflected[3 * i + 1] = mirror.out.unit.y;
    out.reflected[3 * i + 2] = mirror.out.unit.z;
    out.cosine[i] = mirror.towards < 0 ? S(0) : mirror.towards > 1 ? S(1) : mirror.towards;
    if (at.near.data)
      for (int c = 0; c < 4; ++c) out.near[4 * i + c] = element(at.near, y, x, c);
  });
}

template <class S>
void shading_inputs_bwd(const Covered<S>& at, const Inputs<const S>& v, int threads, const MapGrads<S>& grads) {
  const int64_t plane = int64_t(at.view.width) * at.view.height;
  over_blocks(at.count, threads, [&](int64_t i) {
    const int64_t p = at.pixels[i], y = p / at.view.width, x = p % at.view.width;
    const S whole = 1 / element(at.alpha, y, x, 0);
    S v_alpha = 0;
    for (int c = 0; c < 4; ++c) {
      const S g = v.carried[4 * i + c] * whole;
      grads.features[c * plane + p] = g;
      v_alpha -= g * element(at.features, y, x, c) * whole;
    }
    grads.alpha[p] = v_alpha;
    const Mirror<S> mirror(at.view, at.normal, y, x);
    const Vec3<S> n = mirror.normal.unit;
    const Vec3<S> v_out = mirror.out.backward({v.reflected[3 * i], v.reflected[3 * i + 1], v.reflected[3 * i + 2]});
    const S inside = mirror.towards >= 0 && mirror.towards <= 1 ? v.cosine[i] : S(0);
    const S v_towards = 2 * dot(n, v_out) + inside;
    const Vec3<S> v_normal = mirror.normal.backward((2 * mirror.towards) * v_out - v_towards * mirror.ray);
    grads.normal[p] = v_normal.x;
    grads.normal[plane + p] = v_normal.y;
    grads.normal[2 * plane + p] = v_normal.z;
    if (at.near.data)
      for (int c = 0; c < 4; ++c) grads.near[c * plane + p] = v.near[4 * i + c];
  });
}

namespace {

template <class S> S clipped(S linear) { return linear < S(1e-6) ? S(1e-6) : linear > 1 ? S(1) : linear; }
template <class S> S srgb(S x) {
  return x <= S(0.0031308) ? S(12.92) * x : S(1.055) * std::pow(x, S(1 / 2.4)) - S(0.055);
}

}  // namespace

template <class S> void composite(const Composite<S>& in, int threads, S* image) {
  const int64_t plane = int64_t(in.width) * in.height;
  parallel_for(in.height, threads, [&](int64_t y) {
    for (int c = 0; c < 3; ++c)
      for (int64_t x = 0; x < in.width; ++x) {
        S value = (1 - element(in.alpha, y, x, 0)) * in.backdrop[c];
        if (in.behind.data) value += element(in.behind, y, x, c);
        image[c * plane + y * in.width + x] = value;
      }
  });
  over_blocks(in.count, threads, [&](int64_t i) {
    const int64_t p = in.pixels[i];
    const S a = element(in.object_alpha, p / in.width, p % in.width, 0);
    for (int c = 0; c < 3; ++c)
      image[c * plane + p] += a * srgb(clipped(in.diffuse[i * in.diffuse_row + c] + in.radiance[3 * i + c]));
  });
}

template <class S>
void composite_bwd(const Composite<S>& in, Image<S> v_image, int threads, S* v_linear, S* v_object_alpha, S* v_alpha) {
  parallel_for(in.height, threads, [&](int64_t y) {
    for (int64_t x = 0; x < in.width; ++x) {
      S sum = 0;
      for (int c = 0; c < 3; ++c) sum -= element(v_image, y, x, c) * in.backdrop[c];
      v_alpha[y * in.width + x] = sum;
      v_object_alpha[y * in.width + x] = 0;
    }
  });
  over_blocks(in.count, threads, [&](int64_t i) {
    const int64_t p = in.pixels[i], y = p / in.width, x = p % in.width;
    const S a = element(in.object_alpha, y, x, 0);
    S v_a = 0;
    for (int c = 0; c < 3; ++c) {
      const S linear = in.diffuse[i * in.diffuse_row + c] + in.radiance[3 * i + c], q = clipped(linear);
      const S color = srgb(q), v_color = element(v_image, y, x, c);
      v_a += v_color * color;
      const S slope = q <= S(0.0031308) ? S(12.92) : (color + S(0.055)) / (S(2.4) * q);
      const S g = a * v_color * slope;
      const bool stopped = linear < S(1e-6) || (linear > 1 && g < 0);  // a clipped highlight is never pushed up
      v_linear[3 * i + c] = stopped ? S(0) : g;
    }
    v_object_alpha[p] = v_a;
  });
}

template <class S> double normal_agreement(const Agreement<S>& in, int threads) {
  const View<S>& view = in.view;
  const int64_t width = view.width, height = view.height, plane = width * height;
  auto point = [&](int64_t y, int64_t x) {
    const S a = element(in.alpha, y, x, 0), z = element(in.depth, y, x, 0) / (a < S(1e-6) ? S(1e-6) : a);
    return z * pixel_ray(view, y, x);
  };
  std::vector<double> rows(size_t(height), 0.0);
  parallel_for(height, threads, [&](int64_t y) {
    double sum = 0;
    for (int64_t x = 0; x < width; ++x) {
      const int64_t p = y * width + x;
      const S weight = element(in.alpha, y, x, 0);
      const bool border = y == 0 || x == 0 || y == height - 1 || x == width - 1;
      Vec3<S> v_down{0, 0, 0}, v_right{0, 0, 0}, v_normal{0, 0, 0};
      if (!border && weight != 0) {
        const Vec3<S> down = point(y + 1, x) - point(y - 1, x), right = point(y, x + 1) - point(y, x - 1);
        const Unit<S> depth_normal(cross(down, right), S(1e-24)), normal(three(in.normal, y, x), S(1e-16));
        const Vec3<S> seen = mul_transposed(view.world_from_cam, normal.unit);
        sum += double(weight) * (1 - double(dot(seen, depth_normal.unit)));
        const S g = -in.scale * weight;
        const Vec3<S> v_cross = depth_normal.backward(g * seen);
        v_down = cross(right, v_cross);
        v_right = cross(v_cross, down);
        v_normal = normal.backward(g * mul(view.world_from_cam, depth_normal.unit));
      }
      if (!in.scratch) continue;
      const S parts[6] = {v_down.x, v_down.y, v_down.z, v_right.x, v_right.y, v_right.z};
      for (int k = 0; k < 6; ++k) in.scratch[k * plane + p] = parts[k];
      in.v_normal[p] = v_normal.x, in.v_normal[plane + p] = v_normal.y, in.v_normal[2 * plane + p] = v_normal.z;
    }
    rows[size_t(y)] = sum;
  });
  if (in.scratch)
    parallel_for(height, threads, [&](int64_t y) {
      auto part = [&](int64_t yy, int64_t xx, int first) -> Vec3<S> {
        if (yy < 0 || xx < 0 || yy >= height || xx >= width) return {0, 0, 0};
        const S* s = in.scratch + first * plane + yy * width + xx;
        return {s[0], s[plane], s[2 * plane]};
      };
      for (int64_t x = 0; x < width; ++x) {
        const Vec3<S> v = part(y - 1, x, 0) - part(y + 1, x, 0) + part(y, x - 1, 3) - part(y, x + 1, 3);
        const S v_z = dot(v, pixel_ray(view, y, x)), a = element(in.alpha, y, x, 0), d = element(in.depth, y, x, 0);
        const S divisor = a < S(1e-6) ? S(1e-6) : a;
        in.v_depth[y * width + x] = v_z / divisor;
        in.v_alpha[y * width + x] = a < S(1e-6) ? S(0) : -v_z * d / (divisor * divisor);
      }
    });
  double total = 0;
  for (double row : rows) total += row;
  return total;
}

#define REFDGS_SHADE(S)                                                                                      \
  template void shading_inputs<S>(const Covered<S>&, int, const Inputs<S>&);                                 \
  template void shading_inputs_bwd<S>(const Covered<S>&, const Inputs<const S>&, int, const MapGrads<S>&);   \
  template void composite<S>(const Composite<S>&, int, S*);                                                  \
  template void composite_bwd<S>(const Composite<S>&, Image<S>, int, S*, S*, S*);                            \
  template double normal_agreement<S>(const Agreement<S>&, int);
REFDGS_SHADE(float)
REFDGS_SHADE(double)

}  // namespace refdgs
