// Numbers that carry N derivatives (forward mode): core functions templated on their scalar are
// differentiated by calling them with it, on the branch the value takes.
#pragma once

#include <cmath>

#include "core/host_device.h"

namespace gsf {

template <typename T, int N>
struct Dual {
  T v;
  T d[N];

  Dual() = default;
  GSF_HOST_DEVICE explicit Dual(T value) : v(value) {
    for (int i = 0; i < N; ++i) d[i] = T(0);
  }
  // Independent variable number `direction`.
  static GSF_HOST_DEVICE Dual variable(T value, int direction) {
    Dual x(value);
    x.d[direction] = T(1);
    return x;
  }
};

// Value f and derivative slope * da.
template <typename T, int N>
GSF_HOST_DEVICE Dual<T, N> chain(T f, T slope, const Dual<T, N>& a) {
  Dual<T, N> r;
  r.v = f;
  for (int i = 0; i < N; ++i) r.d[i] = slope * a.d[i];
  return r;
}
template <typename T, int N>
GSF_HOST_DEVICE Dual<T, N> chain(T f, T slope_a, const Dual<T, N>& a, T slope_b,
                                 const Dual<T, N>& b) {
  Dual<T, N> r;
  r.v = f;
  for (int i = 0; i < N; ++i) r.d[i] = slope_a * a.d[i] + slope_b * b.d[i];
  return r;
}

template <typename T, int N>
GSF_HOST_DEVICE Dual<T, N> operator-(const Dual<T, N>& a) {
  return chain(-a.v, T(-1), a);
}
template <typename T, int N>
GSF_HOST_DEVICE Dual<T, N> operator+(const Dual<T, N>& a, const Dual<T, N>& b) {
  return chain(a.v + b.v, T(1), a, T(1), b);
}
template <typename T, int N>
GSF_HOST_DEVICE Dual<T, N> operator-(const Dual<T, N>& a, const Dual<T, N>& b) {
  return chain(a.v - b.v, T(1), a, T(-1), b);
}
template <typename T, int N>
GSF_HOST_DEVICE Dual<T, N> operator*(const Dual<T, N>& a, const Dual<T, N>& b) {
  return chain(a.v * b.v, b.v, a, a.v, b);
}
template <typename T, int N>
GSF_HOST_DEVICE Dual<T, N> operator/(const Dual<T, N>& a, const Dual<T, N>& b) {
  const T inverse = T(1) / b.v, quotient = a.v / b.v;
  return chain(quotient, inverse, a, -quotient * inverse, b);
}

template <typename T, int N>
GSF_HOST_DEVICE bool operator<(const Dual<T, N>& a, const Dual<T, N>& b) {
  return a.v < b.v;
}
template <typename T, int N>
GSF_HOST_DEVICE bool operator>(const Dual<T, N>& a, const Dual<T, N>& b) {
  return a.v > b.v;
}
template <typename T, int N>
GSF_HOST_DEVICE bool operator==(const Dual<T, N>& a, const Dual<T, N>& b) {
  return a.v == b.v;
}
template <typename T, int N>
GSF_HOST_DEVICE bool operator!=(const Dual<T, N>& a, const Dual<T, N>& b) {
  return a.v != b.v;
}

template <typename T, int N>
GSF_HOST_DEVICE Dual<T, N> abs(const Dual<T, N>& a) {
  return a.v < T(0) ? -a : a;
}
// At zero the derivative is taken as zero: there the square root ends, it does not go on.
template <typename T, int N>
GSF_HOST_DEVICE Dual<T, N> sqrt(const Dual<T, N>& a) {
  const T root = std::sqrt(a.v);
  return chain(root, root > T(0) ? T(0.5) / root : T(0), a);
}
template <typename T, int N>
GSF_HOST_DEVICE Dual<T, N> log1p(const Dual<T, N>& a) {
  return chain(std::log1p(a.v), T(1) / (T(1) + a.v), a);
}
template <typename T, int N>
GSF_HOST_DEVICE Dual<T, N> sinh(const Dual<T, N>& a) {
  return chain(std::sinh(a.v), std::cosh(a.v), a);
}
// The exponent is a constant of the callers.
template <typename T, int N>
GSF_HOST_DEVICE Dual<T, N> pow(const Dual<T, N>& a, const Dual<T, N>& exponent) {
  const T slope = a.v > T(0) ? exponent.v * std::pow(a.v, exponent.v - T(1)) : T(0);
  return chain(std::pow(a.v, exponent.v), slope, a);
}

}  // namespace gsf
