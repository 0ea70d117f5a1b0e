// How the state of a particle lies in memory. On the CPU particle by particle. On the GPU in planes
// of up to four components per particle, so that neighbouring lanes move 16 neighbouring bytes
// each:
//
//   offset       o_x, o_y, o_z, meta word                       one plane of four
//   velocity     velocity and slope, twelve components          three planes of four
//   strain       six components                                 a plane of four, one of two
//   deformation  nine components                                two planes of four, one of one
//   viscous, own nine components                                likewise
//
// `meta` and `slope` of SolverView are null there.
#pragma once

#include "core/solver/state.h"

namespace gsf {

template <typename T>
struct alignas(16) Quad {
  T x, y, z, w;
};
template <typename T>
struct alignas(2 * sizeof(T)) Pair {
  T x, y;
};

// Plane g of an array on the GPU.
template <typename T>
GSF_HOST_DEVICE Quad<T>* quad_plane(const SolverView<T>& s, T* array, int g) {
  return reinterpret_cast<Quad<T>*>(array) + g * s.count;
}
template <typename T>
GSF_HOST_DEVICE const Quad<T>* quad_plane(const SolverView<T>& s, const T* array, int g) {
  return reinterpret_cast<const Quad<T>*>(array) + g * s.count;
}
template <typename T>
GSF_HOST_DEVICE Pair<T>* strain_pairs(const SolverView<T>& s) {
  return reinterpret_cast<Pair<T>*>(s.strain + 4 * s.count);
}

#ifdef __CUDA_ARCH__
__device__ inline uint32_t word_of(float v) { return __float_as_uint(v); }
__device__ inline uint32_t word_of(double v) {
  return static_cast<uint32_t>(__double_as_longlong(v));
}
__device__ inline void put_word(uint32_t word, float& v) { v = __uint_as_float(word); }
__device__ inline void put_word(uint32_t word, double& v) {
  v = __longlong_as_double(static_cast<long long>(word));
}
#endif

template <typename T>
GSF_HOST_DEVICE uint32_t load_place(const SolverView<T>& s, int64_t p, T* offset) {
#ifdef __CUDA_ARCH__
  const Quad<T> q = *(quad_plane(s, s.offset, 0) + p);
  offset[0] = q.x;
  offset[1] = q.y;
  offset[2] = q.z;
  return word_of(q.w);
#else
  for (int c = 0; c < 3; ++c) offset[c] = s.offset[3 * p + c];
  return s.meta[p];
#endif
}
template <typename T>
GSF_HOST_DEVICE void store_place(const SolverView<T>& s, int64_t p, const T* offset,
                                 uint32_t meta) {
#ifdef __CUDA_ARCH__
  Quad<T> q{offset[0], offset[1], offset[2], T(0)};
  put_word(meta, q.w);
  quad_plane(s, s.offset, 0)[p] = q;
#else
  for (int c = 0; c < 3; ++c) s.offset[3 * p + c] = offset[c];
  s.meta[p] = meta;
#endif
}
template <typename T>
GSF_HOST_DEVICE uint32_t load_meta(const SolverView<T>& s, int64_t p) {
#ifdef __CUDA_ARCH__
  return word_of(s.offset[4 * p + 3]);
#else
  return s.meta[p];
#endif
}
template <typename T>
GSF_HOST_DEVICE void store_meta(const SolverView<T>& s, int64_t p, uint32_t meta) {
#ifdef __CUDA_ARCH__
  put_word(meta, s.offset[4 * p + 3]);
#else
  s.meta[p] = meta;
#endif
}

// Velocity alone.
template <typename T>
GSF_HOST_DEVICE void load_speed(const SolverView<T>& s, int64_t p, T* velocity) {
#ifdef __CUDA_ARCH__
  const Quad<T> a = quad_plane(s, s.velocity, 0)[p];
  velocity[0] = a.x;
  velocity[1] = a.y;
  velocity[2] = a.z;
#else
  for (int c = 0; c < 3; ++c) velocity[c] = s.velocity[3 * p + c];
#endif
}
// Velocity and slope.
template <typename T>
GSF_HOST_DEVICE void load_motion(const SolverView<T>& s, int64_t p, T* velocity, T* slope) {
#ifdef __CUDA_ARCH__
  const Quad<T> a = quad_plane(s, s.velocity, 0)[p], b = quad_plane(s, s.velocity, 1)[p],
                c = quad_plane(s, s.velocity, 2)[p];
  const T values[12] = {a.x, a.y, a.z, a.w, b.x, b.y, b.z, b.w, c.x, c.y, c.z, c.w};
  for (int i = 0; i < 3; ++i) velocity[i] = values[i];
  for (int i = 0; i < 9; ++i) slope[i] = values[3 + i];
#else
  for (int c = 0; c < 3; ++c) velocity[c] = s.velocity[3 * p + c];
  for (int c = 0; c < 9; ++c) slope[c] = s.slope[9 * p + c];
#endif
}
template <typename T>
GSF_HOST_DEVICE void store_motion(const SolverView<T>& s, int64_t p, const T* v, const T* slope) {
#ifdef __CUDA_ARCH__
  quad_plane(s, s.velocity, 0)[p] = {v[0], v[1], v[2], slope[0]};
  quad_plane(s, s.velocity, 1)[p] = {slope[1], slope[2], slope[3], slope[4]};
  quad_plane(s, s.velocity, 2)[p] = {slope[5], slope[6], slope[7], slope[8]};
#else
  for (int c = 0; c < 3; ++c) s.velocity[3 * p + c] = v[c];
  for (int c = 0; c < 9; ++c) s.slope[9 * p + c] = slope[c];
#endif
}

template <typename T>
GSF_HOST_DEVICE Sym3<T> load_strain(const SolverView<T>& s, int64_t p) {
#ifdef __CUDA_ARCH__
  const Quad<T> a = quad_plane(s, s.strain, 0)[p];
  const Pair<T> b = strain_pairs(s)[p];
  return {a.x, a.y, a.z, a.w, b.x, b.y};
#else
  const T* e = s.strain + 6 * p;
  return {e[0], e[1], e[2], e[3], e[4], e[5]};
#endif
}
template <typename T>
GSF_HOST_DEVICE void store_strain(const SolverView<T>& s, int64_t p, const Sym3<T>& e) {
#ifdef __CUDA_ARCH__
  quad_plane(s, s.strain, 0)[p] = {e.xx, e.yy, e.zz, e.xy};
  strain_pairs(s)[p] = {e.xz, e.yz};
#else
  const T values[6] = {e.xx, e.yy, e.zz, e.xy, e.xz, e.yz};
  for (int c = 0; c < 6; ++c) s.strain[6 * p + c] = values[c];
#endif
}

// Nine components of a point: deformation, viscous, own.
template <typename T>
GSF_HOST_DEVICE void load_nine(const SolverView<T>& s, const T* array, int64_t p, T* out) {
#ifdef __CUDA_ARCH__
  const Quad<T> a = quad_plane(s, array, 0)[p], b = quad_plane(s, array, 1)[p];
  const T last = array[8 * s.count + p];
  const T values[9] = {a.x, a.y, a.z, a.w, b.x, b.y, b.z, b.w, last};
  for (int c = 0; c < 9; ++c) out[c] = values[c];
#else
  for (int c = 0; c < 9; ++c) out[c] = array[9 * p + c];
#endif
}
template <typename T>
GSF_HOST_DEVICE void store_nine(const SolverView<T>& s, T* array, int64_t p, const T* f) {
#ifdef __CUDA_ARCH__
  quad_plane(s, array, 0)[p] = {f[0], f[1], f[2], f[3]};
  quad_plane(s, array, 1)[p] = {f[4], f[5], f[6], f[7]};
  array[8 * s.count + p] = f[8];
#else
  for (int c = 0; c < 9; ++c) array[9 * p + c] = f[c];
#endif
}

// The strain of a viscous point's spring, its first six words; `own` as it was loaded.
template <typename T>
GSF_HOST_DEVICE void store_spring(const SolverView<T>& s, int64_t p, const Sym3<T>& e,
                                  const T* own) {
#ifdef __CUDA_ARCH__
  quad_plane(s, s.viscous, 0)[p] = {e.xx, e.yy, e.zz, e.xy};
  quad_plane(s, s.viscous, 1)[p] = {e.xz, e.yz, own[6], own[7]};
#else
  const T values[6] = {e.xx, e.yy, e.zz, e.xy, e.xz, e.yz};
  for (int c = 0; c < 6; ++c) s.viscous[9 * p + c] = values[c];
#endif
}

}  // namespace gsf
