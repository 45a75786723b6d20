// What a camera keeps of one surfel for drawing it, and the way back to the surfel's parameters. The same
// text for every device.
#pragma once
#include <cstdint>

#include "surfel.h"

namespace refdgs {

// A record: x y j00 j01 j10 j11 s0 s1 z opacity cut 0; the contour where the disc's alpha is kMinAlpha:
// its middle (2) and a, b, c, -b/2c, -b/2a of  a x^2 + b x y + c y^2 <= 1  about it (zeros: everywhere);
// 0; then the channels.
constexpr int kContour = 12, kRecordHead = 20;
constexpr int kGradHead = 12;         // x y j00 j01 j10 j11 s0 s1 z opacity |x| |y|

struct Box {
  int16_t x0, y0, x1, y1;  // pixels, inclusive
};

template <class S> REFDGS_HD S least_of(S a, S b) { return b < a ? b : a; }
template <class S> REFDGS_HD S most_of(S a, S b) { return a < b ? b : a; }

// The ellipse of record scalars kContour.. that holds all pixels with squared radius below `cut`, a
// little larger to be safe; zeros if it is no ellipse or has no usable inverse.
template <class S>
REFDGS_HD void contour(const Disc<S>& d, const Pinhole<S>& cam, const Splat<S>& s, S cut, S* out) {
  for (int c = 0; c < 7; ++c) out[c] = 0;
  const S delta = cut * (d.U.z * d.U.z + d.V.z * d.V.z) - s.z * s.z;
  if (!(delta < -S(1e-6) * s.z * s.z)) return;  // the disc reaches the camera's plane
  const Tangents<S> t = tangents(d, cam);
  const S f = cut / delta;
  const S mx = f * (t.a * d.U.z + t.b * d.V.z), my = f * (t.c * d.U.z + t.e * d.V.z);
  S xx = most_of(mx * mx - f * (t.a * t.a + t.b * t.b), S(0));
  S yy = most_of(my * my - f * (t.c * t.c + t.e * t.e), S(0));
  const S xy = mx * my - f * (t.a * t.c + t.b * t.e), more = S(0.01) + S(1e-4) * (xx + yy);
  xx += more, yy += more;
  const S det = xx * yy - xy * xy;
  if (!(det > 0) || !std::isfinite(det)) return;
  const S k = 1 / det;
  out[0] = s.x + mx, out[1] = s.y + my;
  out[2] = yy * k, out[3] = -2 * xy * k, out[4] = xx * k, out[5] = xy / xx, out[6] = xy / yy;
}

// A surfel that is drawn: its splat, squared radius of its cut, pixels and radius on the screen.
template <class S> struct Projected {
  Disc<S> disc;
  Splat<S> splat;
  S cut, radius;
  Box box;  // x1 < x0 where nothing is drawn
};

template <class S>
REFDGS_HD Projected<S> project(const S* mean, const S* quat, const S* scale, S opacity, const Pinhole<S>& cam) {
  Projected<S> p{};
  p.box = {0, 0, -1, -1};
  p.disc = disc_in_camera(mean, quat, scale, cam);
  if (!(p.disc.P.z > cam.near) || !(opacity > S(kMinAlpha))) return p;
  const Splat<S> s = p.splat = splat(p.disc, cam);
  p.cut = S(2) * std::log(opacity / S(kMinAlpha));
  S lo[2], hi[2];
  if (!bounds(p.disc, cam, s, p.cut, lo, hi)) return p;
  if (!std::isfinite(s.j00 + s.j01 + s.j10 + s.j11 + s.s0 + s.s1 + lo[0] + hi[0] + lo[1] + hi[1])) return p;
  // pixels whose centres lie inside
  const int x0 = int(std::ceil(most_of(lo[0], S(0)) - S(0.5))), y0 = int(std::ceil(most_of(lo[1], S(0)) - S(0.5)));
  const int x1 = int(std::floor(least_of(hi[0], S(cam.width)) - S(0.5)));
  const int y1 = int(std::floor(least_of(hi[1], S(cam.height)) - S(0.5)));
  if (x0 > x1 || y0 > y1) return p;
  p.box = {int16_t(most_of(x0, 0)), int16_t(most_of(y0, 0)), int16_t(x1), int16_t(y1)};
  p.radius = S(0.5) * most_of(hi[0] - lo[0], hi[1] - lo[1]);
  return p;
}

// r: [kRecordHead + padded], zeros after the last channel.
template <class S>
REFDGS_HD void write_record(const Projected<S>& p, const Pinhole<S>& cam, S opacity, const S* features, int channels,
                            bool normals, int padded, S* r) {
  const Splat<S>& s = p.splat;
  const S head[kContour] = {s.x, s.y, s.j00, s.j01, s.j10, s.j11, s.s0, s.s1, s.z, opacity, p.cut, S(0)};
  for (int c = 0; c < kContour; ++c) r[c] = head[c];
  contour(p.disc, cam, s, p.cut, r + kContour);
  r[kRecordHead - 1] = 0;
  S* channel = r + kRecordHead;
  for (int c = 0; c < channels; ++c) *channel++ = features[c];
  if (normals) {
    const S sign = p.disc.flipped ? S(-1) : S(1);
    *channel++ = sign * p.disc.axes.n.x, *channel++ = sign * p.disc.axes.n.y, *channel++ = sign * p.disc.axes.n.z;
  }
  while (channel < r + kRecordHead + padded) *channel++ = S(0);
}

// From the gradient g [kGradHead + channels] of a record (g_normal: that of its normal, or null) to the surfel's
// parameters; v_pose (3, 4) is that of cam_from_world.
template <class S> struct SurfelGrad {
  S mean[3], quat[4], scale[2], v_pose[12];
};
template <class S>
REFDGS_HD SurfelGrad<S> record_vjp(const S* mean, const S* quat, const S* scale, const Pinhole<S>& cam, const S* r,
                                   const S* g, const S* g_normal) {
  SurfelGrad<S> out;
  const auto disc = disc_in_camera(mean, quat, scale, cam);
  const Splat<S> s{r[0], r[1], r[2], r[3], r[4], r[5], r[6], r[7], r[8]};
  const Splat<S> gs{g[0], g[1], g[2], g[3], g[4], g[5], g[6], g[7], g[8]};
  const auto gd = splat_vjp(disc, cam, s, gs);
  const auto g_mean = mul_transposed(cam.R, gd.P);
  const auto gU = mul_transposed(cam.R, gd.U), gV = mul_transposed(cam.R, gd.V);
  out.mean[0] = g_mean.x, out.mean[1] = g_mean.y, out.mean[2] = g_mean.z;
  out.scale[0] = dot(gU, disc.axes.u), out.scale[1] = dot(gV, disc.axes.v);
  Frame3<S> g_axes{disc.su * gU, disc.sv * gV, {0, 0, 0}};
  if (g_normal) {
    const S sign = disc.flipped ? S(-1) : S(1);
    g_axes.n = {sign * g_normal[0], sign * g_normal[1], sign * g_normal[2]};
  }
  rotation_vjp(quat, g_axes, out.quat);
  const Vec3<S> tu = disc.su * disc.axes.u, tv = disc.sv * disc.axes.v;
  const S gp[3] = {gd.P.x, gd.P.y, gd.P.z}, gu[3] = {gd.U.x, gd.U.y, gd.U.z}, gv[3] = {gd.V.x, gd.V.y, gd.V.z};
  for (int row = 0; row < 3; ++row) {
    out.v_pose[4 * row] = gp[row] * mean[0] + gu[row] * tu.x + gv[row] * tv.x;
    out.v_pose[4 * row + 1] = gp[row] * mean[1] + gu[row] * tu.y + gv[row] * tv.y;
    out.v_pose[4 * row + 2] = gp[row] * mean[2] + gu[row] * tu.z + gv[row] * tv.z;
    out.v_pose[4 * row + 3] = gp[row];
  }
  return out;
}

}  // namespace refdgs
