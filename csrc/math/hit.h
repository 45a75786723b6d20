// Where one pixel's ray meets one surfel, and which pixels a surfel can reach: the scalar form of what
// ops/rasterize.inl does on vectors of pixels.
#pragma once
#include "record.h"

namespace refdgs {

// As fast as the device has them, to a few units in the last place.
template <class S> REFDGS_HD S exp_of(S x) {
#if defined(__CUDA_ARCH__)
  if constexpr (sizeof(S) == sizeof(float)) return __expf(x);
  else
#endif
    return std::exp(x);
}
template <class S> REFDGS_HD S inverse_of(S x) {
#if defined(__CUDA_ARCH__)
  if constexpr (sizeof(S) == sizeof(float)) return __fdividef(1.0f, x);
  else
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

// Adds to G[0..8] (and G[10], G[11]) what a pixel passes to the record through rho and z.
template <class S> REFDGS_HD void hit_vjp(const PixelHit<S>& h, const S* r, S g_rho, S g_z, S* G) {
  const S on_disc = h.on_disc ? g_rho : S(0), low_pass = S(2 * kLowPass) * (g_rho - on_disc), scaled = 2 * on_disc * h.iq;
  const S gpx = h.u * scaled, gpy = h.v * scaled, gz_disc = h.has_hit ? g_z * h.iq : S(0);
  G[8] += h.has_hit ? gz_disc : g_z;
  const S gq = -(h.u * gpx + h.v * gpy) - gz_disc * h.z;
  const S gdx = gpx * r[2] + gpy * r[4] + gq * r[6] + h.dx * low_pass;
  const S gdy = gpx * r[3] + gpy * r[5] + gq * r[7] + h.dy * low_pass;
  G[0] -= gdx;
  G[1] -= gdy;
  G[2] += gpx * h.dx;
  G[3] += gpx * h.dy;
  G[4] += gpy * h.dx;
  G[5] += gpy * h.dy;
  G[6] += gq * h.dx;
  G[7] += gq * h.dy;
  G[10] += std::fabs(gdx);
  G[11] += std::fabs(gdy);
}

template <class S> REFDGS_HD S nearest_in(S lo, S hi, S to) { return least_of(most_of(to, lo), hi); }

// Whether the surfel's contour or its low-pass circle reaches pixel centres from (x, y) to (x + wide, y + high);
// now and then true for nothing. The least of a convex quadratic over a rectangle lies at its own middle or on
// a side that faces it. Products and sums are joined by hand: a compiler that joins them as it likes could answer
// otherwise in the kernel that counts than in the one that fills what was counted.
template <class S> REFDGS_HD bool reaches(const S* r, S x, S y, S wide, S high) {
  const S* k = r + kContour;
  const S x0 = x - k[0], y0 = y - k[1], x1 = x0 + wide, y1 = y0 + high;
  const S xa = nearest_in(x0, x1, S(0)), ya = nearest_in(y0, y1, k[5] * xa);
  const S yb = nearest_in(y0, y1, S(0)), xb = nearest_in(x0, x1, k[6] * yb);
  const auto at = [&](S px, S py) { return std::fma(px, std::fma(k[2], px, k[3] * py), k[4] * py * py); };
  const S cx = nearest_in(x - r[0], x - r[0] + wide, S(0)), cy = nearest_in(y - r[1], y - r[1] + high, S(0));
  return least_of(at(xa, ya), at(xb, yb)) < S(1.02) || std::fma(cx, cx, cy * cy) < S(1.002 / kLowPass) * r[10];
}

}  // namespace refdgs
