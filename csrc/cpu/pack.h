// Eight floats or four doubles at once, one particle per lane: a value type with the operators of a
// number, so that the branch-free templates of csrc/core take it for T. gcc and clang turn it into
// one AVX register, or into two or more smaller ones elsewhere.
#pragma once

#include <cstdint>
#include <cstring>

#include "core/vec.h"

namespace gsf::cpu {

template <typename T>
struct PackTypes;
template <>
struct PackTypes<float> {
  typedef float Raw __attribute__((vector_size(32)));
  typedef int32_t Int __attribute__((vector_size(32)));
  typedef float Quad __attribute__((vector_size(16)));
};
template <>
struct PackTypes<double> {
  typedef double Raw __attribute__((vector_size(32)));
  typedef int64_t Int __attribute__((vector_size(32)));
  typedef double Quad __attribute__((vector_size(32)));
};

template <typename T>
struct Pack {
  using Raw = typename PackTypes<T>::Raw;
  using Int = typename PackTypes<T>::Int;  // also the mask of a comparison: 0 or -1 per lane
  static constexpr int kLanes = 32 / sizeof(T);

  Raw v;

  Pack() = default;
  Pack(Raw raw) : v(raw) {}
  explicit Pack(double x) : v(static_cast<T>(x) - Raw{}) {}
  explicit Pack(float x) : v(static_cast<T>(x) - Raw{}) {}
  explicit Pack(int x) : v(static_cast<T>(x) - Raw{}) {}

  T operator[](int lane) const { return v[lane]; }
  Pack& operator+=(Pack b) { return v += b.v, *this; }
  Pack& operator-=(Pack b) { return v -= b.v, *this; }
  Pack& operator*=(Pack b) { return v *= b.v, *this; }
  friend Pack operator+(Pack a, Pack b) { return a.v + b.v; }
  friend Pack operator-(Pack a, Pack b) { return a.v - b.v; }
  friend Pack operator*(Pack a, Pack b) { return a.v * b.v; }
  friend Pack operator/(Pack a, Pack b) { return a.v / b.v; }
  friend Pack operator-(Pack a) { return -a.v; }
  friend Int operator<(Pack a, Pack b) { return a.v < b.v; }
  friend Int operator<=(Pack a, Pack b) { return a.v <= b.v; }
  friend Int operator>(Pack a, Pack b) { return a.v > b.v; }
  friend Int operator>=(Pack a, Pack b) { return a.v >= b.v; }
  friend Int operator==(Pack a, Pack b) { return a.v == b.v; }
};

template <typename T>
Pack<T> select(typename Pack<T>::Int mask, Pack<T> yes, Pack<T> no) {
  return mask ? yes.v : no.v;
}
// NaN in either operand gives the second one, as in core/vec.h.
template <typename T>
Pack<T> min(Pack<T> a, Pack<T> b) {
  return a.v < b.v ? a.v : b.v;
}
template <typename T>
Pack<T> max(Pack<T> a, Pack<T> b) {
  return a.v > b.v ? a.v : b.v;
}
template <typename T>
Pack<T> clamp(Pack<T> x, Pack<T> lo, Pack<T> hi) {
  return min(max(x, lo), hi);
}
template <typename T>
Pack<T> abs(Pack<T> x) {
  return max(x, -x);
}

template <typename T>
Pack<T> sqrt(Pack<T> x) {
#ifdef __AVX__
  if constexpr (sizeof(T) == 4)
    return __builtin_ia32_sqrtps256(x.v);
  else
    return __builtin_ia32_sqrtpd256(x.v);
#else
  for (int lane = 0; lane < Pack<T>::kLanes; ++lane) x.v[lane] = std::sqrt(x.v[lane]);
  return x;
#endif
}

template <typename T>
Pack<T> log(Pack<T> x) {
  for (int lane = 0; lane < Pack<T>::kLanes; ++lane) x.v[lane] = std::log(x.v[lane]);
  return x;
}

// Lanes that are neither infinite nor NaN.
template <typename T>
typename Pack<T>::Int finite(Pack<T> x) {
  return (x - x) == Pack<T>(0);
}

// Largest lane.
template <typename T>
T largest_lane(Pack<T> x) {
  T largest = x[0];
  for (int lane = 1; lane < Pack<T>::kLanes; ++lane) largest = gsf::max(largest, x[lane]);
  return largest;
}

// One value per lane, from f(lane).
template <typename T, typename F>
Pack<T> pack_of(const F& f) {
  using Raw = typename Pack<T>::Raw;
  if constexpr (sizeof(T) == 4)
    return Raw{f(0), f(1), f(2), f(3), f(4), f(5), f(6), f(7)};
  else
    return Raw{f(0), f(1), f(2), f(3)};
}
template <typename T, typename F>
typename Pack<T>::Int int_pack_of(const F& f) {
  using Int = typename Pack<T>::Int;
  if constexpr (sizeof(T) == 4)
    return Int{f(0), f(1), f(2), f(3), f(4), f(5), f(6), f(7)};
  else
    return Int{f(0), f(1), f(2), f(3)};
}

// Sign bit of every lane; for a mask, the lanes where it holds.
inline uint32_t mask_bits(PackTypes<float>::Int mask) {
#ifdef __AVX__
  return static_cast<uint32_t>(
      __builtin_ia32_movmskps256(reinterpret_cast<PackTypes<float>::Raw>(mask)));
#else
  uint32_t bits = 0;
  for (int lane = 0; lane < 8; ++lane) bits |= mask[lane] < 0 ? 1u << lane : 0u;
  return bits;
#endif
}
inline uint32_t mask_bits(PackTypes<double>::Int mask) {
#ifdef __AVX__
  return static_cast<uint32_t>(
      __builtin_ia32_movmskpd256(reinterpret_cast<PackTypes<double>::Raw>(mask)));
#else
  uint32_t bits = 0;
  for (int lane = 0; lane < 4; ++lane) bits |= mask[lane] < 0 ? 1u << lane : 0u;
  return bits;
#endif
}

// Whole part towards minus infinity; values beyond +-2^20 are taken as that, NaN as -2^20.
template <typename T>
Pack<T> floor(Pack<T> x, typename Pack<T>::Int& whole) {
  x = clamp(x, Pack<T>(-1048576), Pack<T>(1048576));
  whole = __builtin_convertvector(x.v, typename Pack<T>::Int);
  const Pack<T> toward_zero = __builtin_convertvector(whole, typename Pack<T>::Raw);
  const typename Pack<T>::Int above = toward_zero > x;  // -1 where it is
  whole += above;
  return __builtin_convertvector(whole, typename Pack<T>::Raw);
}

// x^(-1/3) for normal positive x: a guess from the exponent (a float's bits are its logarithm, near
// enough), then third-order corrections y (1 + h/3 + 2 h^2/9) with h = 1 - x y^3.
inline Pack<float> reciprocal_cube_root_guess(Pack<float> x) {
  const PackTypes<float>::Int bits = reinterpret_cast<PackTypes<float>::Int>(x.v);
  const PackTypes<float>::Raw scaled =
      1419967116.0f - __builtin_convertvector(bits, PackTypes<float>::Raw) * (1.0f / 3.0f);
  return reinterpret_cast<PackTypes<float>::Raw>(
      __builtin_convertvector(scaled, PackTypes<float>::Int));
}
inline Pack<double> reciprocal_cube_root_guess(Pack<double> x) {
  const PackTypes<double>::Int bits = reinterpret_cast<PackTypes<double>::Int>(x.v);
  PackTypes<double>::Int guess;
  for (int lane = 0; lane < 4; ++lane)
    guess[lane] =
        static_cast<int64_t>(6142914900000000000.0 - static_cast<double>(bits[lane]) / 3.0);
  return reinterpret_cast<PackTypes<double>::Raw>(guess);
}
template <typename T>
Pack<T> reciprocal_cube_root(Pack<T> x) {
  Pack<T> y = reciprocal_cube_root_guess(x);
  for (int i = 0; i < (sizeof(T) == 4 ? 2 : 3); ++i) {
    const Pack<T> h = Pack<T>(1) - x * y * (y * y);
    y += y * h * (Pack<T>(1.0 / 3.0) + Pack<T>(2.0 / 9.0) * h);
  }
  return y;
}

// --- rows of particles to lanes and back ---

template <typename T>
using Quad = typename PackTypes<T>::Quad;

template <typename T>
Quad<T> load_quad(const T* p) {
  Quad<T> q;
  std::memcpy(&q, p, sizeof q);
  return q;
}

template <typename T>
Pack<T> load_pack(const T* p) {
  typename Pack<T>::Raw raw;
  std::memcpy(&raw, p, sizeof raw);
  return raw;
}
template <typename T>
void store_pack(T* p, Pack<T> x) {
  std::memcpy(p, &x.v, sizeof x.v);
}

// Four columns of the rows whose quads are `q`, one per lane.
inline void transpose(const Quad<float>* q, Pack<float>* out) {
  typedef PackTypes<float>::Raw R;
  R r[4];
  for (int i = 0; i < 4; ++i)
    r[i] = __builtin_shufflevector(q[i], q[i + 4], 0, 1, 2, 3, 4, 5, 6, 7);
  const R a = __builtin_shufflevector(r[0], r[1], 0, 8, 1, 9, 4, 12, 5, 13);
  const R b = __builtin_shufflevector(r[2], r[3], 0, 8, 1, 9, 4, 12, 5, 13);
  const R c = __builtin_shufflevector(r[0], r[1], 2, 10, 3, 11, 6, 14, 7, 15);
  const R d = __builtin_shufflevector(r[2], r[3], 2, 10, 3, 11, 6, 14, 7, 15);
  out[0] = __builtin_shufflevector(a, b, 0, 1, 8, 9, 4, 5, 12, 13);
  out[1] = __builtin_shufflevector(a, b, 2, 3, 10, 11, 6, 7, 14, 15);
  out[2] = __builtin_shufflevector(c, d, 0, 1, 8, 9, 4, 5, 12, 13);
  out[3] = __builtin_shufflevector(c, d, 2, 3, 10, 11, 6, 7, 14, 15);
}
inline void transpose(const Pack<float>* in, Quad<float>* q) {
  typedef PackTypes<float>::Raw R;
  const R a = __builtin_shufflevector(in[0].v, in[1].v, 0, 8, 1, 9, 4, 12, 5, 13);
  const R b = __builtin_shufflevector(in[2].v, in[3].v, 0, 8, 1, 9, 4, 12, 5, 13);
  const R c = __builtin_shufflevector(in[0].v, in[1].v, 2, 10, 3, 11, 6, 14, 7, 15);
  const R d = __builtin_shufflevector(in[2].v, in[3].v, 2, 10, 3, 11, 6, 14, 7, 15);
  const R r[4] = {__builtin_shufflevector(a, b, 0, 1, 8, 9, 4, 5, 12, 13),
                  __builtin_shufflevector(a, b, 2, 3, 10, 11, 6, 7, 14, 15),
                  __builtin_shufflevector(c, d, 0, 1, 8, 9, 4, 5, 12, 13),
                  __builtin_shufflevector(c, d, 2, 3, 10, 11, 6, 7, 14, 15)};
  for (int i = 0; i < 4; ++i) {
    q[i] = __builtin_shufflevector(r[i], r[i], 0, 1, 2, 3);
    q[i + 4] = __builtin_shufflevector(r[i], r[i], 4, 5, 6, 7);
  }
}
inline void transpose(const Quad<double>* q, Pack<double>* out) {
  typedef PackTypes<double>::Raw R;
  const R a = __builtin_shufflevector(q[0], q[1], 0, 4, 2, 6);
  const R b = __builtin_shufflevector(q[2], q[3], 0, 4, 2, 6);
  const R c = __builtin_shufflevector(q[0], q[1], 1, 5, 3, 7);
  const R d = __builtin_shufflevector(q[2], q[3], 1, 5, 3, 7);
  out[0] = __builtin_shufflevector(a, b, 0, 1, 4, 5);
  out[1] = __builtin_shufflevector(c, d, 0, 1, 4, 5);
  out[2] = __builtin_shufflevector(a, b, 2, 3, 6, 7);
  out[3] = __builtin_shufflevector(c, d, 2, 3, 6, 7);
}
inline void transpose(const Pack<double>* in, Quad<double>* q) {
  Pack<double> out[4];
  const Quad<double> rows[4] = {in[0].v, in[1].v, in[2].v, in[3].v};
  transpose(rows, out);
  for (int i = 0; i < 4; ++i) q[i] = out[i].v;
}

}  // namespace gsf::cpu
