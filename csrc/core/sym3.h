// Algebra of symmetric 3x3 tensors needed by the constitutive update: invariants of I + e without
// cancellation, and the strain update. No decomposition (eigenvalues: core/spectral.h).
#pragma once

#include "core/vec.h"

namespace gsf {

template <typename T>
GSF_HOST_DEVICE Sym3<T> operator*(T s, const Sym3<T>& a) {
  return {s * a.xx, s * a.yy, s * a.zz, s * a.xy, s * a.xz, s * a.yz};
}

template <typename T>
GSF_HOST_DEVICE Sym3<T> operator+(const Sym3<T>& a, const Sym3<T>& b) {
  return {a.xx + b.xx, a.yy + b.yy, a.zz + b.zz, a.xy + b.xy, a.xz + b.xz, a.yz + b.yz};
}

// a a, symmetric like a.
template <typename T>
GSF_HOST_DEVICE Sym3<T> square(const Sym3<T>& a) {
  return {a.xx * a.xx + a.xy * a.xy + a.xz * a.xz, a.xy * a.xy + a.yy * a.yy + a.yz * a.yz,
          a.xz * a.xz + a.yz * a.yz + a.zz * a.zz, a.xx * a.xy + a.xy * a.yy + a.xz * a.yz,
          a.xx * a.xz + a.xy * a.yz + a.xz * a.zz, a.xy * a.xz + a.yy * a.yz + a.yz * a.zz};
}

template <typename T>
GSF_HOST_DEVICE Sym3<T> add_diagonal(const Sym3<T>& a, T c) {
  return {a.xx + c, a.yy + c, a.zz + c, a.xy, a.xz, a.yz};
}

template <typename T>
GSF_HOST_DEVICE Sym3<T> deviator(const Sym3<T>& a) {
  return add_diagonal(a, trace(a) * T(-1.0 / 3.0));
}

template <typename T>
GSF_HOST_DEVICE T det(const Sym3<T>& a) {
  return a.xx * (a.yy * a.zz - a.yz * a.yz) - a.xy * (a.xy * a.zz - a.yz * a.xz) +
         a.xz * (a.xy * a.yz - a.yy * a.xz);
}

// a : a, the squared Frobenius norm.
template <typename T>
GSF_HOST_DEVICE T norm2(const Sym3<T>& a) {
  return a.xx * a.xx + a.yy * a.yy + a.zz * a.zz + T(2) * (a.xy * a.xy + a.xz * a.xz + a.yz * a.yz);
}

template <typename T>
GSF_HOST_DEVICE T max_abs(const Sym3<T>& a) {
  using std::abs;
  return max(max(max(abs(a.xx), abs(a.yy)), max(abs(a.zz), abs(a.xy))), max(abs(a.xz), abs(a.yz)));
}

// False when any entry is NaN or infinite. (A maximum would not do: comparisons drop NaN.)
template <typename T>
GSF_HOST_DEVICE bool finite(const Sym3<T>& a) {
  return finite(a.xx) && finite(a.yy) && finite(a.zz) && finite(a.xy) && finite(a.xz) &&
         finite(a.yz);
}

// det(I + e) - 1 = I1 + I2 + I3 of e: exact to rounding of e itself, where forming I + e first
// would lose every digit of a strain below the machine epsilon.
template <typename T>
GSF_HOST_DEVICE T det_minus_one(const Sym3<T>& e) {
  const T second =
      (e.xx * e.yy - e.xy * e.xy) + (e.xx * e.zz - e.xz * e.xz) + (e.yy * e.zz - e.yz * e.yz);
  return trace(e) + second + det(e);
}

// det(I + A) - 1 for a general A, exact to rounding of A.
template <typename T>
GSF_HOST_DEVICE T det_minus_one(const Mat3<T>& a) {
  const T second = (a(0, 0) * a(1, 1) - a(0, 1) * a(1, 0)) +
                   (a(0, 0) * a(2, 2) - a(0, 2) * a(2, 0)) +
                   (a(1, 1) * a(2, 2) - a(1, 2) * a(2, 1));
  return a(0, 0) + a(1, 1) + a(2, 2) + second + det(a);
}

template <typename T>
GSF_HOST_DEVICE T det_identity_plus(const Mat3<T>& a) {
  return T(1) + det_minus_one(a);
}

// (I + A)(I + e)(I + A)^T - I = e + H + H^T + H A^T with H = A (I + e).
template <typename T>
GSF_HOST_DEVICE Sym3<T> update_strain(const Sym3<T>& e, const Mat3<T>& a) {
  const Mat3<T> h = a + matmul(a, to_mat3(e));
  const auto entry = [&](int i, int j) {
    return h(i, j) + h(j, i) + (h(i, 0) * a(j, 0) + h(i, 1) * a(j, 1) + h(i, 2) * a(j, 2));
  };
  return {e.xx + entry(0, 0), e.yy + entry(1, 1), e.zz + entry(2, 2),
          e.xy + entry(0, 1), e.xz + entry(0, 2), e.yz + entry(1, 2)};
}

// Largest root m of det(m I + d) = m^3 - h m + det(d) - 1 = 0 for a traceless d, returned as
// y = m - 1 so that small strains keep their digits: y^3 + 3 y^2 + (3 - h) y - (h - det d) = 0.
// Newton from an upper bound is monotone there; it stops when a step no longer changes y.
template <typename T>
GSF_HOST_DEVICE T unit_det_shift(const Sym3<T>& d) {
  using std::abs;
  using std::sqrt;
  const T h = T(0.5) * norm2(d);
  const T c = h - det(d);
  // Two bounds: m <= 1 + 2 sqrt(h/3) always; y <= c / (3 - h) when that is positive, because the
  // dropped y^3 + 3 y^2 are. The second is the sharp one at small strain.
  T y = T(2) * sqrt(h / T(3));
  if (h < T(2) && c >= T(0)) y = min(y, c / (T(3) - h));
  const T eps = sizeof(T) == 4 ? T(6e-8) : T(1.1e-16);
  for (int i = 0; i < 40; ++i) {
    const T f = ((y + T(3)) * y + (T(3) - h)) * y - c;
    const T slope = (T(3) * y + T(6)) * y + (T(3) - h);
    const T step = slope > T(0) ? f / slope : T(0);
    y -= step;
    if (!(abs(step) > T(4) * eps * abs(y))) break;
  }
  return y;
}

}  // namespace gsf
