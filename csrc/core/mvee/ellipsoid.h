// An ellipsoid as it is stored: rounded to the caller's type without losing a point of it.
#pragma once

#include "core/svd3.h"
#include "core/sym3.h"

namespace gsf {

// { x : (x - center)^T shape^-1 (x - center) <= 1 }
template <typename T>
struct Ellipsoid {
  Vec3<T> center;
  Sym3<T> shape;
};

namespace detail {

using Dvec = Vec3<double>;
using Dmat = Mat3<double>;

// Lower Cholesky factor; vanishing pivots become slivers.
GSF_HOST_DEVICE Dmat cholesky3(const Sym3<double>& s) {
  using std::sqrt;
  const double least = 1e-20 * (s.xx + s.yy + s.zz) + 1e-300;
  Dmat l{};
  l(0, 0) = sqrt(max(s.xx, least));
  l(1, 0) = s.xy / l(0, 0);
  l(2, 0) = s.xz / l(0, 0);
  l(1, 1) = sqrt(max(s.yy - l(1, 0) * l(1, 0), least));
  l(2, 1) = (s.yz - l(2, 0) * l(1, 0)) / l(1, 1);
  l(2, 2) = sqrt(max(s.zz - l(2, 0) * l(2, 0) - l(2, 1) * l(2, 1), least));
  return l;
}

GSF_HOST_DEVICE Dmat lower_inverse(const Dmat& l) {
  Dmat r{};
  for (int i = 0; i < 3; ++i) r(i, i) = 1.0 / l(i, i);
  r(1, 0) = -l(1, 0) * r(0, 0) * r(1, 1);
  r(2, 1) = -l(2, 1) * r(1, 1) * r(2, 2);
  r(2, 0) = -(l(2, 0) * r(0, 0) + l(2, 1) * r(1, 0)) * r(2, 2);
  return r;
}

}  // namespace detail

// The ellipsoid { center + root z, |z| <= 1 }, its shape times `factor`. In float it is widened by
// what rounding of the centre and of the shape may take away.
template <typename T>
GSF_HOST_DEVICE Ellipsoid<T> stored_ellipsoid(const Vec3<double>& center, const Mat3<double>& root,
                                              double factor) {
  Ellipsoid<T> r;
  r.center = {T(center.x), T(center.y), T(center.z)};
  Mat3<double> s = matmul(root, transpose(root));
  if (sizeof(T) == 4) {
    // The rounded centre is off by d: (1 + t) s + (1 + 1/t) d d^T contains the ellipsoid moved by
    // d.
    const Vec3<double> d{center.x - double(r.center.x), center.y - double(r.center.y),
                         center.z - double(r.center.z)};
    const Mat3<double> l =
        detail::cholesky3({s(0, 0), s(1, 1), s(2, 2), s(0, 1), s(0, 2), s(1, 2)});
    const double t = norm(matvec(detail::lower_inverse(l), d));
    const double other = t > 1e-12 ? 1.0 + 1.0 / t : 0.0;
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) s(i, j) = (1.0 + t) * s(i, j) + other * d[i] * d[j];
    // Entries rounded by half an ulp change x^T s x by at most 3/2 ulp of the diagonal's part.
    for (int i = 0; i < 3; ++i) s(i, i) *= 1.0 + 1.9e-7;
  }
  r.shape = {T(factor * s(0, 0)), T(factor * s(1, 1)), T(factor * s(2, 2)),
             T(factor * s(0, 1)), T(factor * s(0, 2)), T(factor * s(1, 2))};
  return r;
}

}  // namespace gsf
