// The deferred shading of one pixel around the shader's network, and its way back: the scalar form of what
// ops/shade.inl does on vectors of pixels.
#pragma once
#include <cstdint>

#include "vec.h"

namespace refdgs {

// v / sqrt(|v|^2 + eps) and its backward pass.
template <class S> struct UnitVector {
  Vec3<S> v, unit;
  S scale;
  REFDGS_HD UnitVector(Vec3<S> a, S eps) : v(a), scale(1 / std::sqrt(dot(a, a) + eps)) { unit = scale * a; }
  REFDGS_HD Vec3<S> backward(Vec3<S> g) const { return scale * g - (scale * scale * scale * dot(v, g)) * v; }
};

// The mirror at one pixel: the ray (unit, world), the surface's normal, where the ray goes.
template <class S> struct MirrorAt {
  Vec3<S> ray;
  UnitVector<S> normal;
  S towards;
  UnitVector<S> out;
  REFDGS_HD MirrorAt(Vec3<S> unit_ray, Vec3<S> splatted)
      : ray(unit_ray), normal(splatted, S(1e-16)), towards(-dot(normal.unit, ray)),
        out(ray + (2 * towards) * normal.unit, S(1e-16)) {}
  REFDGS_HD S cosine() const { return towards < 0 ? S(0) : towards > 1 ? S(1) : towards; }
  // From the gradients by the mirrored ray and the cosine to the splatted normal's.
  REFDGS_HD Vec3<S> backward(Vec3<S> v_reflected, S v_cosine) const {
    const Vec3<S> v_out = out.backward(v_reflected);
    const S inside = towards >= 0 && towards <= 1 ? v_cosine : S(0), v_towards = 2 * dot(normal.unit, v_out) + inside;
    return normal.backward((2 * towards) * v_out - v_towards * ray);
  }
};

template <class S> REFDGS_HD S clipped_linear(S linear) {
  return linear < S(1e-6) ? S(1e-6) : linear > 1 ? S(1) : linear;
}
template <class S> REFDGS_HD S srgb_curve(S x) {
  return x <= S(0.0031308) ? S(12.92) * x : S(1.055) * std::pow(x, S(1 / 2.4)) - S(0.055);
}
// dL/d linear for image = a srgb(clipped(linear)), g = a dL/d image; a clipped highlight is never pushed up.
template <class S> REFDGS_HD S srgb_vjp(S linear, S g_image) {
  const S q = clipped_linear(linear);
  const S slope = q <= S(0.0031308) ? S(12.92) : (srgb_curve(q) + S(0.055)) / (S(2.4) * q), g = g_image * slope;
  return linear < S(1e-6) || (linear > 1 && g < 0) ? S(0) : g;
}

// Whether the depth's second differences are below `edge` footprints of a pixel, as within one surface.
template <class S> REFDGS_HD bool lies_on_a_surface(S above, S below, S left, S right, S here, S fx, S edge) {
  const S vertical = std::fabs(above + below - 2 * here), horizontal = std::fabs(left + right - 2 * here);
  return (vertical < horizontal ? horizontal : vertical) * fx < edge * here;
}

// n . n_depth at a pixel from its four neighbours' points; gradients of scale times weight (1 - it).
template <class S> struct NormalPair {
  S agreement;
  Vec3<S> v_down, v_right, v_normal;
  REFDGS_HD NormalPair(Vec3<S> down, Vec3<S> right, Vec3<S> splatted, const Mat3<S>& world_from_cam, S g) {
    const UnitVector<S> depth_normal(cross(down, right), S(1e-24)), normal(splatted, S(1e-16));
    const Vec3<S> seen = mul_transposed(world_from_cam, normal.unit);
    agreement = dot(seen, depth_normal.unit);
    const Vec3<S> v_cross = depth_normal.backward(g * seen);
    v_down = cross(right, v_cross);
    v_right = cross(v_cross, down);
    v_normal = normal.backward(g * mul(world_from_cam, depth_normal.unit));
  }
};

}  // namespace refdgs
