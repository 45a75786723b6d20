// A surfel (2-D Gaussian on a disc) as one camera sees it, and the derivative of that.
//
// The disc's point (u, v) lies at P + u U + v V in the camera (U, V: tangents scaled by the standard
// deviations). With d = pixel - centre, the ray through the pixel meets the disc's plane at
//     (u, v) = J d / q,    q = 1 + slope . d,    depth = z / q,
// which is the adjugate form of the homography of 2D Gaussian Splatting (Huang et al. 2024, eq. 8-10)
// with its origin moved to the projected centre: nothing cancels far from the image's corner.
#pragma once
#include "blend.h"
#include "vec.h"

namespace refdgs {

template <class S> struct Pinhole {
  Mat3<S> R;  // cam_from_world
  Vec3<S> t;
  S fx, fy, cx, cy;
  int width, height;
  S near;  // surfels and hits nearer than this are not drawn
};

template <class S> struct Splat {
  S x, y;                 // projected centre, pixels
  S j00, j01, j10, j11;   // J
  S s0, s1;               // slope
  S z;                    // depth of the centre
};

template <class S> struct Disc {
  Frame3<S> axes;      // world
  Vec3<S> P, U, V;     // camera
  S su, sv;
  bool flipped;        // the stored normal points away from the camera
};

template <class S>
REFDGS_HD Disc<S> disc_in_camera(const S* mean, const S* quat, const S* scale, const Pinhole<S>& cam) {
  Disc<S> d;
  d.axes = rotation(quat);
  d.su = scale[0];
  d.sv = scale[1];
  d.P = mul(cam.R, Vec3<S>{mean[0], mean[1], mean[2]}) + cam.t;
  d.U = d.su * mul(cam.R, d.axes.u);
  d.V = d.sv * mul(cam.R, d.axes.v);
  // Every ray that meets the disc's plane sees the same side of it, so one test of the centre is exact.
  d.flipped = dot(mul(cam.R, d.axes.n), d.P) > 0;
  return d;
}

// The screen-space tangents times z: d(pixel) * q = (a b; c e) (u, v) / z.
template <class S> struct Tangents {
  S a, b, c, e, det;
  bool clamped;
};
template <class S> REFDGS_HD Tangents<S> tangents(const Disc<S>& d, const Pinhole<S>& cam) {
  const S px = d.P.x / d.P.z, py = d.P.y / d.P.z;
  Tangents<S> t;
  t.a = cam.fx * (d.U.x - d.U.z * px);
  t.b = cam.fx * (d.V.x - d.V.z * px);
  t.c = cam.fy * (d.U.y - d.U.z * py);
  t.e = cam.fy * (d.V.y - d.V.z * py);
  t.det = t.a * t.e - t.b * t.c;
  const S least = S(kMinDeterminant) * (t.a * t.a + t.b * t.b + t.c * t.c + t.e * t.e);
  t.clamped = std::fabs(t.det) < least;
  if (t.clamped) t.det = t.det < 0 ? -least : least;
  return t;
}

template <class S> REFDGS_HD Splat<S> splat(const Disc<S>& d, const Pinhole<S>& cam) {
  const Tangents<S> t = tangents(d, cam);
  const S k = d.P.z / t.det;
  Splat<S> s;
  s.z = d.P.z;
  s.x = cam.fx * d.P.x / d.P.z + cam.cx;
  s.y = cam.fy * d.P.y / d.P.z + cam.cy;
  s.j00 = t.e * k;
  s.j01 = -t.b * k;
  s.j10 = -t.c * k;
  s.j11 = t.a * k;
  s.s0 = -(d.U.z * s.j00 + d.V.z * s.j10) / s.z;
  s.s1 = -(d.U.z * s.j01 + d.V.z * s.j11) / s.z;
  return s;
}

// Gradients of the disc in the camera.
template <class S> struct DiscGrad {
  Vec3<S> P, U, V;
};
template <class S>
REFDGS_HD DiscGrad<S> splat_vjp(const Disc<S>& d, const Pinhole<S>& cam, const Splat<S>& s, const Splat<S>& g) {
  const Tangents<S> t = tangents(d, cam);
  const S iz = S(1) / d.P.z, px = d.P.x * iz, py = d.P.y * iz, k = d.P.z / t.det;
  DiscGrad<S> out{{0, 0, 0}, {0, 0, 0}, {0, 0, 0}};
  // slope
  S g00 = g.j00 - g.s0 * d.U.z * iz, g10 = g.j10 - g.s0 * d.V.z * iz;
  S g01 = g.j01 - g.s1 * d.U.z * iz, g11 = g.j11 - g.s1 * d.V.z * iz;
  out.U.z -= (g.s0 * s.j00 + g.s1 * s.j01) * iz;
  out.V.z -= (g.s0 * s.j10 + g.s1 * s.j11) * iz;
  S gz = g.z - (g.s0 * s.s0 + g.s1 * s.s1) * iz;
  // J = k (e -b; -c a), k = z / det
  const S gk = g00 * t.e - g01 * t.b - g10 * t.c + g11 * t.a;
  S ga = g11 * k, gb = -g01 * k, gc = -g10 * k, ge = g00 * k;
  gz += gk / t.det;
  const S gdet = -gk * k / t.det;
  if (!t.clamped) {
    ga += gdet * t.e;
    ge += gdet * t.a;
    gb -= gdet * t.c;
    gc -= gdet * t.b;
  } else {
    const S m = 2 * (t.det < 0 ? -gdet : gdet) * S(kMinDeterminant);
    ga += m * t.a;
    gb += m * t.b;
    gc += m * t.c;
    ge += m * t.e;
  }
  // a b c e and the centre
  out.U.x += cam.fx * ga;
  out.V.x += cam.fx * gb;
  out.U.y += cam.fy * gc;
  out.V.y += cam.fy * ge;
  out.U.z -= cam.fx * px * ga + cam.fy * py * gc;
  out.V.z -= cam.fx * px * gb + cam.fy * py * ge;
  const S gpx = cam.fx * (g.x - d.U.z * ga - d.V.z * gb), gpy = cam.fy * (g.y - d.U.z * gc - d.V.z * ge);
  out.P.x = gpx * iz;
  out.P.y = gpy * iz;
  out.P.z = gz - (gpx * px + gpy * py) * iz;
  return out;
}

// Screen bounds of the part with alpha >= kMinAlpha: the disc's conic at squared radius `cut`, and the
// low-pass circle. False if nothing is on the screen.
template <class S>
REFDGS_HD bool bounds(const Disc<S>& d, const Pinhole<S>& cam, const Splat<S>& s, S cut, S* lo, S* hi) {
  const Tangents<S> t = tangents(d, cam);
  const S low_pass = std::sqrt(cut / S(kLowPass));
  lo[0] = s.x - low_pass, hi[0] = s.x + low_pass, lo[1] = s.y - low_pass, hi[1] = s.y + low_pass;
  const S delta = cut * (d.U.z * d.U.z + d.V.z * d.V.z) - s.z * s.z;
  if (delta >= -S(1e-6) * s.z * s.z) {  // the disc reaches the camera's plane
    lo[0] = lo[1] = 0;
    hi[0] = S(cam.width), hi[1] = S(cam.height);
  } else {
    const S f = cut / delta;
    const S mx = f * (t.a * d.U.z + t.b * d.V.z), my = f * (t.c * d.U.z + t.e * d.V.z);
    const S ex = mx * mx - f * (t.a * t.a + t.b * t.b), ey = my * my - f * (t.c * t.c + t.e * t.e);
    const S rx = std::sqrt(ex > 0 ? ex : 0), ry = std::sqrt(ey > 0 ? ey : 0);
    lo[0] = s.x + mx - rx < lo[0] ? s.x + mx - rx : lo[0];
    hi[0] = s.x + mx + rx > hi[0] ? s.x + mx + rx : hi[0];
    lo[1] = s.y + my - ry < lo[1] ? s.y + my - ry : lo[1];
    hi[1] = s.y + my + ry > hi[1] ? s.y + my + ry : hi[1];
  }
  return hi[0] >= 0 && lo[0] <= cam.width && hi[1] >= 0 && lo[1] <= cam.height;
}

}  // namespace refdgs
