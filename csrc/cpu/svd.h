// Singular value decompositions of eight (or, in double, four) matrices at once, one per lane: what
// core/svd3.h does, without branches. Lanes that would take one are left to it;
// tests/ops/test_deform.py holds the two together.
#pragma once

#include "core/svd3.h"
#include "cpu/pack.h"

namespace gsf::cpu {

// jacobi_rotate of core/svd3.h.
template <typename T>
void jacobi_rotate(Mat3<Pack<T>>& a, Mat3<Pack<T>>& v, int p, int q) {
  using P = Pack<T>;
  using detail::column, detail::set_column;
  const Vec3<P> ap = column(a, p), aq = column(a, q);
  const P app = dot(ap, ap), aqq = dot(aq, aq), apq = dot(ap, aq);
  const P num = P(2) * apq, diff = aqq - app;
  const P root = sqrt(diff * diff + num * num);
  const P den = abs(diff) + root;
  P t = select<T>(den > P(0), num / den, P(0));
  t = select<T>(diff < P(0), -t, t);
  const P c = P(1) / sqrt(P(1) + t * t), s = c * t;
  const Vec3<P> vp = column(v, p), vq = column(v, q);
  set_column(a, p, c * ap - s * aq);
  set_column(a, q, s * ap + c * aq);
  set_column(v, p, c * vp - s * vq);
  set_column(v, q, s * vp + c * vq);
}

// order_columns of core/svd3.h.
template <typename T>
void order_columns(Mat3<Pack<T>>& a, Mat3<Pack<T>>& v, int p, int q) {
  using detail::column;
  const auto stays = dot(column(a, p), column(a, p)) >= dot(column(a, q), column(a, q));
  for (Mat3<Pack<T>>* m : {&a, &v})
    for (int i = 0; i < 3; ++i) {
      const Pack<T> x = (*m)(i, p), y = (*m)(i, q);
      (*m)(i, p) = select<T>(stays, x, y);
      (*m)(i, q) = select<T>(stays, y, -x);
    }
}

// svd3 of every lane that `plain` has then; it loses those that are zero, flat or not finite.
template <typename T>
Svd3<Pack<T>> svd3(const Mat3<Pack<T>>& f, typename Pack<T>::Int& plain) {
  using P = Pack<T>;
  using detail::column, detail::set_column;
  P scale(0);
  for (int i = 0; i < 9; ++i) {
    scale = max(scale, abs(f.m[i]));
    plain &= (f.m[i] - f.m[i]) <= P(0);  // not so of what is not finite
  }
  plain &= scale > P(0);
  Svd3<P> r;
  r.v = identity3<P>();
  Mat3<P> a;
  for (int i = 0; i < 9; ++i) a.m[i] = f.m[i] / scale;
  for (int sweep = 0; sweep < 6; ++sweep) {
    jacobi_rotate<T>(a, r.v, 0, 1);
    jacobi_rotate<T>(a, r.v, 0, 2);
    jacobi_rotate<T>(a, r.v, 1, 2);
  }
  order_columns<T>(a, r.v, 0, 1);
  order_columns<T>(a, r.v, 0, 2);
  order_columns<T>(a, r.v, 1, 2);
  const Vec3<P> a0 = column(a, 0), a1 = column(a, 1), a2 = column(a, 2);
  const P s0 = norm(a0);
  const Vec3<P> u0 = (P(1) / s0) * a0;
  const Vec3<P> p1 = a1 - dot(u0, a1) * u0;
  const P s1 = norm(p1);
  plain &= s1 > P(sizeof(T) == 4 ? 1e-18 : 1e-150);
  const Vec3<P> u1 = (P(1) / s1) * p1;
  const Vec3<P> u2 = cross(u0, u1);
  set_column(r.u, 0, u0);
  set_column(r.u, 1, u1);
  set_column(r.u, 2, u2);
  r.sigma = {scale * s0, scale * s1, scale * dot(u2, a2)};
  return r;
}

}  // namespace gsf::cpu
