// Small fixed-size value types: Vec3, Mat3 (row-major), Sym3 (xx, yy, zz, xy, xz, yz). No
// allocation, no torch.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/host_device.h"

namespace gsf {

// Scalar functions by one name for float and double, on host and device.
template <typename T>
GSF_HOST_DEVICE T min(T a, T b) {
  return a < b ? a : b;
}
template <typename T>
GSF_HOST_DEVICE T max(T a, T b) {
  return a > b ? a : b;
}
template <typename T>
GSF_HOST_DEVICE T clamp(T x, T lo, T hi) {
  return x < lo ? lo : (x > hi ? hi : x);
}
// True for every finite value; written by comparison so that it also holds without <cmath>
// classification on device.
template <typename T>
GSF_HOST_DEVICE bool finite(T x) {
  return (x - x) == T(0);
}

template <typename T>
struct Vec3 {
  T x, y, z;
  GSF_HOST_DEVICE T& operator[](int i) { return i == 0 ? x : (i == 1 ? y : z); }
  GSF_HOST_DEVICE const T& operator[](int i) const { return i == 0 ? x : (i == 1 ? y : z); }
};

template <typename T>
GSF_HOST_DEVICE Vec3<T> operator+(const Vec3<T>& a, const Vec3<T>& b) {
  return {a.x + b.x, a.y + b.y, a.z + b.z};
}
template <typename T>
GSF_HOST_DEVICE Vec3<T> operator-(const Vec3<T>& a, const Vec3<T>& b) {
  return {a.x - b.x, a.y - b.y, a.z - b.z};
}
template <typename T>
GSF_HOST_DEVICE Vec3<T> operator*(T s, const Vec3<T>& a) {
  return {s * a.x, s * a.y, s * a.z};
}
template <typename T>
GSF_HOST_DEVICE T dot(const Vec3<T>& a, const Vec3<T>& b) {
  return a.x * b.x + a.y * b.y + a.z * b.z;
}
template <typename T>
GSF_HOST_DEVICE Vec3<T> cross(const Vec3<T>& a, const Vec3<T>& b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
template <typename T>
GSF_HOST_DEVICE T norm(const Vec3<T>& a) {
  using std::sqrt;
  return sqrt(dot(a, a));
}

template <typename T>
struct Mat3 {
  T m[9];
  GSF_HOST_DEVICE T& operator()(int i, int j) { return m[3 * i + j]; }
  GSF_HOST_DEVICE const T& operator()(int i, int j) const { return m[3 * i + j]; }
};

template <typename T>
GSF_HOST_DEVICE Mat3<T> identity3() {
  return {{T(1), T(0), T(0), T(0), T(1), T(0), T(0), T(0), T(1)}};
}
template <typename T>
GSF_HOST_DEVICE Vec3<T> load_vec3(const T* p) {
  return {p[0], p[1], p[2]};
}
template <typename T>
GSF_HOST_DEVICE void store_vec3(T* p, const Vec3<T>& v) {
  p[0] = v.x;
  p[1] = v.y;
  p[2] = v.z;
}
template <typename T>
GSF_HOST_DEVICE Mat3<T> load_mat3(const T* p) {
  Mat3<T> r;
  for (int i = 0; i < 9; ++i) r.m[i] = p[i];
  return r;
}
template <typename T>
GSF_HOST_DEVICE void store_mat3(T* p, const Mat3<T>& a) {
  for (int i = 0; i < 9; ++i) p[i] = a.m[i];
}
template <typename T>
GSF_HOST_DEVICE Mat3<T> operator+(const Mat3<T>& a, const Mat3<T>& b) {
  Mat3<T> r;
  for (int i = 0; i < 9; ++i) r.m[i] = a.m[i] + b.m[i];
  return r;
}
template <typename T>
GSF_HOST_DEVICE Mat3<T> operator*(T s, const Mat3<T>& a) {
  Mat3<T> r;
  for (int i = 0; i < 9; ++i) r.m[i] = s * a.m[i];
  return r;
}
template <typename T>
GSF_HOST_DEVICE Mat3<T> matmul(const Mat3<T>& a, const Mat3<T>& b) {
  Mat3<T> r;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) r(i, j) = a(i, 0) * b(0, j) + a(i, 1) * b(1, j) + a(i, 2) * b(2, j);
  return r;
}
template <typename T>
GSF_HOST_DEVICE Vec3<T> matvec(const Mat3<T>& a, const Vec3<T>& v) {
  return {a.m[0] * v.x + a.m[1] * v.y + a.m[2] * v.z, a.m[3] * v.x + a.m[4] * v.y + a.m[5] * v.z,
          a.m[6] * v.x + a.m[7] * v.y + a.m[8] * v.z};
}
template <typename T>
GSF_HOST_DEVICE Mat3<T> transpose(const Mat3<T>& a) {
  return {{a.m[0], a.m[3], a.m[6], a.m[1], a.m[4], a.m[7], a.m[2], a.m[5], a.m[8]}};
}
template <typename T>
GSF_HOST_DEVICE T det(const Mat3<T>& a) {
  return a.m[0] * (a.m[4] * a.m[8] - a.m[5] * a.m[7]) -
         a.m[1] * (a.m[3] * a.m[8] - a.m[5] * a.m[6]) +
         a.m[2] * (a.m[3] * a.m[7] - a.m[4] * a.m[6]);
}

// Symmetric 3x3 in the order xx, yy, zz, xy, xz, yz (the layout of every [N, 6] tensor of
// gsfluent).
template <typename T>
struct Sym3 {
  T xx, yy, zz, xy, xz, yz;
};

template <typename T>
GSF_HOST_DEVICE Sym3<T> load_sym3(const T* p) {
  return {p[0], p[1], p[2], p[3], p[4], p[5]};
}
template <typename T>
GSF_HOST_DEVICE void store_sym3(T* p, const Sym3<T>& s) {
  p[0] = s.xx;
  p[1] = s.yy;
  p[2] = s.zz;
  p[3] = s.xy;
  p[4] = s.xz;
  p[5] = s.yz;
}
template <typename T>
GSF_HOST_DEVICE Mat3<T> to_mat3(const Sym3<T>& s) {
  return {{s.xx, s.xy, s.xz, s.xy, s.yy, s.yz, s.xz, s.yz, s.zz}};
}
template <typename T>
GSF_HOST_DEVICE T trace(const Sym3<T>& s) {
  return s.xx + s.yy + s.zz;
}

}  // namespace gsf
