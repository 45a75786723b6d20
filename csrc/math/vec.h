// Small vectors and matrices, the same text for g++ and nvcc, for any scalar.
#pragma once
#include <cmath>

#if defined(__CUDACC__)
#define REFDGS_HD __host__ __device__ inline
#else
#define REFDGS_HD inline
#endif

namespace refdgs {

template <class S> struct Vec3 {
  S x, y, z;
};
template <class S> REFDGS_HD Vec3<S> operator+(Vec3<S> a, Vec3<S> b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
template <class S> REFDGS_HD Vec3<S> operator-(Vec3<S> a, Vec3<S> b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
template <class S> REFDGS_HD Vec3<S> operator*(S s, Vec3<S> a) { return {s * a.x, s * a.y, s * a.z}; }
template <class S> REFDGS_HD S dot(Vec3<S> a, Vec3<S> b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

template <class S> REFDGS_HD Vec3<S> cross(Vec3<S> a, Vec3<S> b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

// Row-major 3x3.
template <class S> struct Mat3 {
  S m[9];
};
template <class S> REFDGS_HD Vec3<S> mul(const Mat3<S>& A, Vec3<S> v) {
  return {A.m[0] * v.x + A.m[1] * v.y + A.m[2] * v.z, A.m[3] * v.x + A.m[4] * v.y + A.m[5] * v.z,
          A.m[6] * v.x + A.m[7] * v.y + A.m[8] * v.z};
}
template <class S> REFDGS_HD Vec3<S> mul_transposed(const Mat3<S>& A, Vec3<S> v) {
  return {A.m[0] * v.x + A.m[3] * v.y + A.m[6] * v.z, A.m[1] * v.x + A.m[4] * v.y + A.m[7] * v.z,
          A.m[2] * v.x + A.m[5] * v.y + A.m[8] * v.z};
}

// The columns of the rotation of a quaternion q = (w, x, y, z), which is normalised first.
template <class S> struct Frame3 {
  Vec3<S> u, v, n;
};
template <class S> REFDGS_HD Frame3<S> rotation(const S* q) {
  const S s = S(1) / std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  const S w = q[0] * s, x = q[1] * s, y = q[2] * s, z = q[3] * s;
  return {{1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)},
          {2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)},
          {2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)}};
}
// Adds nothing: writes the gradient with respect to the (unnormalised) quaternion.
template <class S> REFDGS_HD void rotation_vjp(const S* q, const Frame3<S>& g, S* v_q) {
  const S s = S(1) / std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  const S w = q[0] * s, x = q[1] * s, y = q[2] * s, z = q[3] * s;
  const Vec3<S>&a = g.u, &b = g.v, &c = g.n;
  const S gw = 2 * (z * (a.y - b.x) + y * (c.x - a.z) + x * (b.z - c.y));
  const S gx = 2 * (y * (a.y + b.x) + z * (a.z + c.x) + w * (b.z - c.y)) - 4 * x * (b.y + c.z);
  const S gy = 2 * (x * (a.y + b.x) + z * (b.z + c.y) + w * (c.x - a.z)) - 4 * y * (a.x + c.z);
  const S gz = 2 * (x * (a.z + c.x) + y * (b.z + c.y) + w * (a.y - b.x)) - 4 * z * (a.x + b.y);
  const S along = gw * w + gx * x + gy * y + gz * z;
  v_q[0] = (gw - along * w) * s;
  v_q[1] = (gx - along * x) * s;
  v_q[2] = (gy - along * y) * s;
  v_q[3] = (gz - along * z) * s;
}

}  // namespace refdgs
