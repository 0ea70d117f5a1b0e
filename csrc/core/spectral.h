// Functions of a symmetric tensor (log, square root, exponential) near the identity, accurate
// relative to the strain: power series while strains are small, eigenvalues of e = b - I beyond.
//
// With eigenvalues x1 >= x2 >= x3 of e, f(e) is the Newton polynomial
//   f(x1) I + f[x1,x2] (e - x1 I) + f[x1,x2,x3] (e - x1 I)(e - x2 I)
// whose divided differences have closed forms without cancellation. An error of size h in the
// eigenvalues changes the result by f''' h^2 only, so no eigenvectors are needed.
#pragma once

#include "core/sym3.h"

namespace gsf {

// a e^2 + b e + c I, a polynomial in e reduced by Cayley-Hamilton.
template <typename T>
struct Quadratic {
  T a, b, c;
};

// x + ratio(1) x^2 + ratio(1) ratio(2) x^3 + ... (`terms` of them) of the tensor with invariants
// I1, I2, I3, as a Quadratic in it. Horner's scheme from the highest term.
template <typename T, int terms, class Ratio>
GSF_HOST_DEVICE Quadratic<T> power_series(T first, T second, T third, const Ratio& ratio) {
  Quadratic<T> q{T(0), T(1), T(0)};
#ifdef __CUDACC__
#pragma unroll
#endif
  for (int n = terms - 1; n >= 1; --n) {
    // q <- e (I + ratio q), e^3 = I1 e^2 - I2 e + I3 I
    const T r = T(ratio(n));
    const T a = r * q.a, b = r * q.b, c = T(1) + r * q.c;
    q = {a * first + b, c - a * second, a * third};
  }
  return q;
}

// Strains with |e| (Frobenius) below this take the series; its last term is below rounding.
inline constexpr double kSeriesStrain = 0.05;
template <typename T>
inline constexpr int kSeriesTerms = sizeof(T) == 4 ? 5 : 11;

template <typename T>
GSF_HOST_DEVICE T second_invariant(const Sym3<T>& e) {
  return (e.xx * e.yy - e.xy * e.xy) + (e.xx * e.zz - e.xz * e.xz) + (e.yy * e.zz - e.yz * e.yz);
}

// Eigenvalues, largest first, by cyclic Jacobi rotations: to rounding of the largest entry.
template <typename T>
GSF_HOST_DEVICE_COLD Vec3<T> eigenvalues_jacobi(const Sym3<T>& e) {
  using std::abs;
  using std::sqrt;
  T a[3] = {e.xx, e.yy, e.zz}, o[3] = {e.yz, e.xz, e.xy};  // o[k]: entry off row and column k
  for (int sweep = 0; sweep < 6; ++sweep) {
    for (int k = 0; k < 3; ++k) {
      const int i = (k + 1) % 3, j = (k + 2) % 3;
      if (o[k] == T(0)) continue;
      const T theta = (a[j] - a[i]) / (T(2) * o[k]);
      const T t = (theta < T(0) ? T(-1) : T(1)) / (abs(theta) + sqrt(theta * theta + T(1)));
      if (!finite(theta)) {
        o[k] = T(0);
        continue;
      }
      const T c = T(1) / sqrt(t * t + T(1)), s = t * c;
      a[i] -= t * o[k];
      a[j] += t * o[k];
      o[k] = T(0);
      const T u = o[i], v = o[j];  // entries (j, k) and (i, k)
      o[j] = c * v - s * u;
      o[i] = s * v + c * u;
    }
  }
  const T hi = max(a[0], max(a[1], a[2])), lo = min(a[0], min(a[1], a[2]));
  return {hi, max(min(a[0], a[1]), min(max(a[0], a[1]), a[2])), lo};
}

// Eigenvalues, largest first, by the trigonometric formula: to about 3e-5 of |dev e| in float32.
template <typename T>
GSF_HOST_DEVICE Vec3<T> eigenvalues_analytic(const Sym3<T>& e) {
  using std::acos;
  using std::cos;
  using std::sqrt;
  const T mean = trace(e) / T(3);
  const Sym3<T> d = deviator(e);
  const T p = sqrt(norm2(d) * T(1.0 / 6.0));
  if (!(p > T(0))) return {mean, mean, mean};
  const T r = clamp(T(0.5) * det((T(1) / p) * d), T(-1), T(1));
  const T angle = acos(r) * T(1.0 / 3.0);
  const T x = T(2) * p * cos(angle);
  const T z = T(2) * p * cos(angle + T(2.0943951023931957));  // 2 pi / 3
  return {mean + x, mean - (x + z), mean + z};
}

// The analytic ones, or Jacobi's where b is so ill-conditioned that their error shows in ln b.
template <typename T>
GSF_HOST_DEVICE Vec3<T> eigenvalues(const Sym3<T>& e) {
  const Vec3<T> x = eigenvalues_analytic(e);
  const T conditioned = sizeof(T) == 4 ? T(0.03) : T(1e-4);
  return T(1) + x.z < conditioned * (T(1) + x.x) ? eigenvalues_jacobi(e) : x;
}

inline constexpr double kEigenvalueMin = 1e-6;  // of b: what rounding may make of a flat state

// ln(1 + z) / z, exact to rounding also at z = 0.
template <typename T>
GSF_HOST_DEVICE T log1p_over(T z) {
  using std::log1p;
  return z == T(0) ? T(1) : log1p(z) / z;
}

// Deviator of the Hencky strain ln V = ln(I + e) / 2, for strains of any size.
template <typename T>
GSF_HOST_DEVICE_COLD Sym3<T> log_deviator_large(const Sym3<T>& e) {
  const Vec3<T> x = eigenvalues(e);
  const T floor = T(kEigenvalueMin);
  const T b1 = max(T(1) + x.x, floor), b2 = max(T(1) + x.y, floor), b3 = max(T(1) + x.z, floor);
  const T f12 = T(0.5) * log1p_over((b1 - b2) / b2) / b2;
  const T f23 = T(0.5) * log1p_over((b2 - b3) / b3) / b3;
  const T f123 = b1 > b3 ? (f12 - f23) / (b1 - b3) : T(0);
  // On the deviator d of e, whose eigenvalues sum to zero: (d - y1)(d - y2) = d^2 + y3 d + y1 y2.
  const Sym3<T> d = deviator(e);
  const T y3 = x.z - (x.x + x.y + x.z) / T(3);
  return (f12 + f123 * y3) * d + f123 * deviator(square(d));
}

// Hencky strain, split: its deviator, and ln J, the trace.
template <typename T>
struct Logarithm {
  Sym3<T> deviator;
  T log_j;
};

template <typename T>
GSF_HOST_DEVICE Logarithm<T> log_small(const Sym3<T>& e) {
  const auto ratio = [](int n) { return -double(n) / double(n + 1); };
  const T first = trace(e);
  const Quadratic<T> q =
      power_series<T, kSeriesTerms<T>>(first, second_invariant(e), det(e), ratio);
  const Sym3<T> e2 = square(e);
  return {T(0.5) * q.b * deviator(e) + T(0.5) * q.a * deviator(e2),
          T(0.5) * (T(3) * q.c + q.b * first + q.a * trace(e2))};
}

// V - I = sqrt(I + e) - I.
template <typename T>
GSF_HOST_DEVICE Sym3<T> sqrt_minus_identity(const Sym3<T>& e) {
  using std::sqrt;
  if (norm2(e) < T(kSeriesStrain * kSeriesStrain)) {
    const auto ratio = [](int n) { return (0.5 - double(n)) / double(n + 1); };
    const Quadratic<T> q =
        power_series<T, kSeriesTerms<T>>(trace(e), second_invariant(e), det(e), ratio);
    return add_diagonal(T(0.5) * q.b * e + T(0.5) * q.a * square(e), T(0.5) * q.c);
  }
  const Vec3<T> x = eigenvalues(e);
  const T s1 = sqrt(max(T(1) + x.x, T(0))), s2 = sqrt(max(T(1) + x.y, T(0))),
          s3 = sqrt(max(T(1) + x.z, T(0)));
  const T f12 = T(1) / (s1 + s2);
  const T f123 = T(-1) / ((s1 + s2) * (s2 + s3) * (s1 + s3));
  const T mean = (x.x + x.y + x.z) / T(3);
  const T y1 = x.x - mean, y2 = x.y - mean, y3 = x.z - mean;
  const Sym3<T> d = add_diagonal(e, -mean);
  return add_diagonal((f12 + f123 * y3) * d + f123 * square(d),
                      (s1 - T(1)) - f12 * y1 + f123 * y1 * y2);
}

// exp(x) - I by scaling and squaring: (I + y)^2 - I = 2 y + y^2 keeps small arguments.
template <typename T>
GSF_HOST_DEVICE Sym3<T> exp_minus_identity(Sym3<T> x) {
  const auto ratio = [](int n) { return 1.0 / double(n + 1); };
  int doublings = 0;
  for (T n2 = norm2(x); n2 > T(0.0625) && doublings < 12; n2 *= T(0.25)) ++doublings;
  x = (T(1) / T(1 << doublings)) * x;
  const Quadratic<T> q =
      power_series<T, sizeof(T) == 4 ? 7 : 12>(trace(x), second_invariant(x), det(x), ratio);
  Sym3<T> y = add_diagonal(q.b * x + q.a * square(x), q.c);
  for (int i = 0; i < doublings; ++i) y = T(2) * y + square(y);
  return y;
}

}  // namespace gsf
