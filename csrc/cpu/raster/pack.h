// A register of 8 floats or 4 doubles as the compiler's vector type, with the few functions the
// blend loop needs. GCC and clang compile it to AVX, NEON or scalar code.
#pragma once

#ifdef __AVX__
#include <immintrin.h>
#endif

#include "cpu/pack.h"

namespace gsf {

template <typename T>
using Pack = typename cpu::PackTypes<T>::Raw;
template <typename T>
using PackMask = typename cpu::PackTypes<T>::Int;

template <typename T>
inline Pack<T> splat_pack(T x) {
  return Pack<T>{} + x;
}

template <typename T>
inline Pack<T> load_pack(const T* p) {
  Pack<T> v;
  std::memcpy(&v, p, sizeof v);
  return v;
}

template <typename V, typename T>
inline void store_pack(T* p, const V& v) {
  static_assert(sizeof v == 32);
  std::memcpy(p, &v, sizeof v);
}

using cpu::mask_bits;

template <typename T>
inline Pack<T> pack_max(Pack<T> a, Pack<T> b) {
  return a > b ? a : b;
}
template <typename T>
inline Pack<T> pack_min(Pack<T> a, Pack<T> b) {
  return a < b ? a : b;
}
template <typename T>
inline Pack<T> pack_sqrt(Pack<T> a) {
  return cpu::sqrt(cpu::Pack<T>(a)).v;
}

template <typename T>
inline Pack<T> pack_abs(Pack<T> a) {
  return a < Pack<T>{} ? -a : a;
}

template <typename T>
inline T pack_sum(Pack<T> a) {
  T s = T(0);
  for (int i = 0; i < cpu::Pack<T>::kLanes; ++i) s += a[i];
  return s;
}
template <>
inline float pack_sum<float>(Pack<float> a) {
  const float s0 = a[0] + a[4], s1 = a[1] + a[5], s2 = a[2] + a[6], s3 = a[3] + a[7];
  return (s0 + s2) + (s1 + s3);
}

// Sums of the lanes of eight packs (four with double), lane k holding that of v[k].
template <typename T>
inline Pack<T> pack_sums(const Pack<T>* v) {
  Pack<T> sums{};
  for (int k = 0; k < cpu::Pack<T>::kLanes; ++k) sums[k] = pack_sum<T>(v[k]);
  return sums;
}
#ifdef __AVX__
template <>
inline Pack<float> pack_sums<float>(const Pack<float>* v) {
  const __m256 a = _mm256_hadd_ps(_mm256_hadd_ps(v[0], v[1]), _mm256_hadd_ps(v[2], v[3]));
  const __m256 b = _mm256_hadd_ps(_mm256_hadd_ps(v[4], v[5]), _mm256_hadd_ps(v[6], v[7]));
  return _mm256_add_ps(_mm256_permute2f128_ps(a, b, 0x20), _mm256_permute2f128_ps(a, b, 0x31));
}
#endif

// 2^x for -126 <= x <= 128, infinite from there on; relative error below 1.5e-7. 2^f on
// |f| <= 1/2 is the polynomial of degree 5 with the smallest relative error, 7.5e-8 (Remez).
inline Pack<float> exp2_pack(Pack<float> x) {
  // Adding 1.5 * 2^23 rounds to the nearest integer and leaves it in the low mantissa bits.
  const float magic = 12582912.0f;
  const Pack<float> shifted = x + magic;
  const Pack<float> f = x - (shifted - magic);
  Pack<float> p = 1.3276471993e-3f * f + 9.6755413344e-3f;
  p = p * f + 5.5507132735e-2f;
  p = p * f + 2.4022119724e-1f;
  p = p * f + 6.9314696706e-1f;
  p = p * f + 1.0000000717f;
  PackMask<float> n;
  std::memcpy(&n, &shifted, sizeof n);
  n = (n << 23) + 0x3f800000;
  Pack<float> scale;
  std::memcpy(&scale, &n, sizeof scale);
  return p * scale;
}
inline Pack<double> exp2_pack(Pack<double> x) {
  for (int i = 0; i < 4; ++i) x[i] = std::exp2(x[i]);
  return x;
}

// -|x| where the mask holds, x elsewhere.
template <typename T>
inline Pack<T> negative_magnitude(Pack<T> x, PackMask<T> where) {
  PackMask<T> bits;
  std::memcpy(&bits, &x, sizeof bits);
  bits |= where << (8 * sizeof(T) - 1);
  std::memcpy(&x, &bits, sizeof bits);
  return x;
}

}  // namespace gsf
