// Where one pixel's ray meets one surfel, and which pixels a surfel can reach: the scalar form of what
// ops/rasterize.inl does on vectors of pixels.
#pragma once
#include "record.h"

namespace refdgs {

// As fast as the device has them, to a few units in the last place. Arguments and results are normal numbers, or
// count as 0.
template <class S> REFDGS_HD S exp_of(S x) {
#if defined(__CUDA_ARCH__)
  if constexpr (sizeof(S) == sizeof(float)) {
    float y;
    asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x * 1.4426950408889634f));
    return y;
  } else
#endif
    return std::exp(x);
}
template <class S> REFDGS_HD S inverse_of(S x) {
#if defined(__CUDA_ARCH__)
  if constexpr (sizeof(S) == sizeof(float)) {
    float y;
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
    return y;
  } else
#endif
    return S(1) / x;
}

template <class S> struct PixelHit {
  S dx, dy, iq, u, v, rho, z;
  bool on_disc, has_hit, visible;
};

// r: a record's head.
template <class S> REFDGS_HD PixelHit<S> pixel_hit(const S* r, S x, S y, S near) {
  PixelHit<S> h;
  h.dx = x - r[0];
  h.dy = y - r[1];
  const S q = 1 + r[6] * h.dx + r[7] * h.dy;
  const bool in_front = q > S(1e-9);  // not behind the horizon
  h.iq = in_front ? inverse_of(q) : S(0);
  h.u = (r[2] * h.dx + r[3] * h.dy) * h.iq;
  h.v = (r[4] * h.dx + r[5] * h.dy) * h.iq;
  const S rho3 = h.u * h.u + h.v * h.v, rho2 = S(kLowPass) * (h.dx * h.dx + h.dy * h.dy);
  h.on_disc = in_front && rho3 <= rho2;
  h.has_hit = in_front && rho3 <= S(kHitRadius2);
  h.rho = h.on_disc ? rho3 : rho2;
  h.z = h.has_hit ? r[8] * h.iq : r[8];
  h.visible = h.rho < r[10] && h.z > near;
  return h;
}

// What a pixel passes on to one surfel: its weight, and the gradients by (u, v) of the plane before the division by q,
// by q, by the squared radius on the disc and of the low-pass filter, and by the depth where the ray meets the disc.
// The gradients by the record are sums of these, and of their products with dx and dy.
template <class S> struct Passed {
  S w = 0, px = 0, py = 0, q = 0, on_disc = 0, low_pass = 0, z = 0;

  REFDGS_HD void take(const PixelHit<S>& h, S g_rho, S g_z) {
    on_disc = h.on_disc ? g_rho : S(0), low_pass = g_rho - on_disc;
    const S scaled = 2 * on_disc * h.iq;
    px = h.u * scaled, py = h.v * scaled;
    z = h.has_hit ? g_z * h.iq : g_z;
    q = -(h.u * px + h.v * py) - (h.has_hit ? z * h.z : S(0));
  }
};

template <class S> REFDGS_HD S nearest_in(S lo, S hi, S to) { return least_of(most_of(to, lo), hi); }

// What says which pixels a surfel reaches, and its depth: the contour and more of its record.
template <class S> struct Shape {
  S contour[7], cut, x, y, z, none;
};

// Whether the surfel's contour or its low-pass circle reaches pixel centres from (x, y) to (x + wide, y + high);
// now and then true for nothing. The least of a convex quadratic over a rectangle lies at its own middle or on
// a side that faces it. Products and sums are joined by hand: a compiler that joins them as it likes could answer
// otherwise in the kernel that counts than in the one that fills what was counted.
template <class S> REFDGS_HD bool reaches(const Shape<S>& s, S x, S y, S wide, S high) {
  const S* k = s.contour;
  const S x0 = x - k[0], y0 = y - k[1], x1 = x0 + wide, y1 = y0 + high;
  const S xa = nearest_in(x0, x1, S(0)), ya = nearest_in(y0, y1, k[5] * xa);
  const S yb = nearest_in(y0, y1, S(0)), xb = nearest_in(x0, x1, k[6] * yb);
  const auto at = [&](S px, S py) { return std::fma(px, std::fma(k[2], px, k[3] * py), k[4] * py * py); };
  const S cx = nearest_in(x - s.x, x - s.x + wide, S(0)), cy = nearest_in(y - s.y, y - s.y + high, S(0));
  return least_of(at(xa, ya), at(xb, yb)) < S(1.02) || std::fma(cx, cx, cy * cy) < S(1.002 / kLowPass) * s.cut;
}

}  // namespace refdgs
