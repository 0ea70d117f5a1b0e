// Singular value decomposition of one 3x3 matrix by one-sided Jacobi with a fixed number of sweeps,
// and the polar pieces made of it. Used per frame (carrying Gaussians), not in the constitutive
// update, which needs no decomposition (nacc.h).
#pragma once

#include "core/vec.h"

namespace gsf {

// F = U diag(sigma) V^T with U, V in SO(3), sigma[0] >= sigma[1] >= |sigma[2]|; sigma[2] carries
// the sign of det F.
template <typename T>
struct Svd3 {
  Mat3<T> u, v;
  Vec3<T> sigma;
};

namespace detail {

template <typename T>
GSF_HOST_DEVICE Vec3<T> column(const Mat3<T>& a, int j) {
  return {a(0, j), a(1, j), a(2, j)};
}

template <typename T>
GSF_HOST_DEVICE void set_column(Mat3<T>& a, int j, const Vec3<T>& c) {
  a(0, j) = c.x;
  a(1, j) = c.y;
  a(2, j) = c.z;
}

// Rotates columns p, q of a and v so that the columns of a become orthogonal.
template <typename T>
GSF_HOST_DEVICE void jacobi_rotate(Mat3<T>& a, Mat3<T>& v, int p, int q) {
  using std::abs;
  using std::sqrt;
  const Vec3<T> ap = column(a, p), aq = column(a, q);
  const T app = dot(ap, ap), aqq = dot(aq, aq), apq = dot(ap, aq);
  // tan of the angle by the smaller root; a zero apq gives the identity rotation.
  const T num = T(2) * apq, diff = aqq - app;
  const T root = sqrt(diff * diff + num * num);
  const T den = abs(diff) + root;
  T t = den > T(0) ? num / den : T(0);
  t = diff < T(0) ? -t : t;
  const T c = T(1) / sqrt(T(1) + t * t), s = c * t;
  const Vec3<T> vp = column(v, p), vq = column(v, q);
  set_column(a, p, c * ap - s * aq);
  set_column(a, q, s * ap + c * aq);
  set_column(v, p, c * vp - s * vq);
  set_column(v, q, s * vp + c * vq);
}

// Swaps columns p, q with a sign so that det stays +1, when column p is the shorter one.
template <typename T>
GSF_HOST_DEVICE void order_columns(Mat3<T>& a, Mat3<T>& v, int p, int q) {
  const Vec3<T> ap = column(a, p), aq = column(a, q);
  if (dot(ap, ap) >= dot(aq, aq)) return;
  const Vec3<T> vp = column(v, p), vq = column(v, q);
  set_column(a, p, aq);
  set_column(a, q, T(-1) * ap);
  set_column(v, p, vq);
  set_column(v, q, T(-1) * vp);
}

// Unit vector along `x` made orthogonal to the unit vector `n`; falls back to `y`, then to an axis.
template <typename T>
GSF_HOST_DEVICE Vec3<T> orthogonal_unit(const Vec3<T>& n, const Vec3<T>& x, const Vec3<T>& y) {
  const Vec3<T> px = x - dot(n, x) * n;
  const Vec3<T> py = y - dot(n, y) * n;
  // The longer of two projections: for orthonormal x, y one of them is at least 1/sqrt(2) long.
  const Vec3<T> best = dot(px, px) >= dot(py, py) ? px : py;
  return (T(1) / norm(best)) * best;
}

}  // namespace detail

// One-sided Jacobi (Hestenes), 6 sweeps: the off-diagonal falls quadratically, 5 reach float64 for
// condition numbers to 1e6. Input must be finite; any scale is accepted.
template <typename T>
GSF_HOST_DEVICE Svd3<T> svd3(const Mat3<T>& f) {
  using std::abs;
  using std::sqrt;
  T scale = T(0);
  for (int i = 0; i < 9; ++i) scale = max(scale, abs(f.m[i]));
  Svd3<T> r;
  r.v = identity3<T>();
  if (!(scale > T(0))) {
    r.u = identity3<T>();
    r.sigma = {T(0), T(0), T(0)};
    return r;
  }
  Mat3<T> a;
  for (int i = 0; i < 9; ++i) a.m[i] = f.m[i] / scale;
  for (int sweep = 0; sweep < 6; ++sweep) {
    detail::jacobi_rotate(a, r.v, 0, 1);
    detail::jacobi_rotate(a, r.v, 0, 2);
    detail::jacobi_rotate(a, r.v, 1, 2);
  }
  detail::order_columns(a, r.v, 0, 1);
  detail::order_columns(a, r.v, 0, 2);
  detail::order_columns(a, r.v, 1, 2);

  // Columns of U: the long one directly, the second made orthogonal to it, the third by the cross
  // product, which puts the sign of det F on sigma[2]. A vanishing second column takes the
  // direction of V, so that the polar rotation of a flattened state stays as near to I as it can.
  const Vec3<T> a0 = detail::column(a, 0), a1 = detail::column(a, 1), a2 = detail::column(a, 2);
  const T s0 = norm(a0);
  const Vec3<T> u0 = (T(1) / s0) * a0;
  const Vec3<T> p1 = a1 - dot(u0, a1) * u0;
  const T s1 = norm(p1);
  const T tiny = sizeof(T) == 4 ? T(1e-18) : T(1e-150);
  const Vec3<T> u1 =
      s1 > tiny ? (T(1) / s1) * p1
                : detail::orthogonal_unit(u0, detail::column(r.v, 1), detail::column(r.v, 2));
  const Vec3<T> u2 = cross(u0, u1);
  detail::set_column(r.u, 0, u0);
  detail::set_column(r.u, 1, u1);
  detail::set_column(r.u, 2, u2);
  r.sigma = {scale * s0, scale * (s1 > tiny ? s1 : T(0)), scale * dot(u2, a2)};
  return r;
}

// U diag(s) V^T.
template <typename T>
GSF_HOST_DEVICE Mat3<T> compose_svd(const Mat3<T>& u, const Vec3<T>& s, const Mat3<T>& v) {
  Mat3<T> r;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      r(i, j) = u(i, 0) * s.x * v(j, 0) + u(i, 1) * s.y * v(j, 1) + u(i, 2) * s.z * v(j, 2);
  return r;
}

// Rotation R = U V^T of F = R S, and F with its stretches clamped to [lo, hi]. A reflected F
// (det < 0) has its smallest stretch raised to lo, i.e. it is un-inverted. A non-finite F yields
// the identity in both: the carrier is drawn undeformed instead of spreading NaN over the image.
template <typename T>
GSF_HOST_DEVICE bool polar_clamped(const Mat3<T>& f, T lo, T hi, Mat3<T>& rotation,
                                   Mat3<T>& clamped) {
  bool ok = true;
  for (int i = 0; i < 9; ++i) ok = ok && finite(f.m[i]);
  if (!ok) {
    rotation = identity3<T>();
    clamped = identity3<T>();
    return false;
  }
  const Svd3<T> d = svd3(f);
  const Vec3<T> s = {clamp(d.sigma.x, lo, hi), clamp(d.sigma.y, lo, hi), clamp(d.sigma.z, lo, hi)};
  rotation = compose_svd(d.u, Vec3<T>{T(1), T(1), T(1)}, d.v);
  clamped = compose_svd(d.u, s, d.v);
  return true;
}

}  // namespace gsf
