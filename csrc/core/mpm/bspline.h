// Quadratic B-spline stencil of one particle: base node, offset, weights, weight derivatives. No
// grid storage here. Source: Jiang et al. 2016 (MPM course notes); shared/spec equations.md
// section 8.
#pragma once

#include "core/vec.h"

namespace gsf {

// The 27 nodes base + (i, j, k), i, j, k in {0, 1, 2}; f = x / dx - base lies in [1/2, 3/2] on each
// axis.
template <typename T>
struct Stencil {
  int32_t base[3];
  T f[3];
  T w[3][3];  // w[axis][node]

  GSF_HOST_DEVICE T weight(int i, int j, int k) const { return w[0][i] * w[1][j] * w[2][k]; }

  // Derivative of w[axis][node] with respect to x_p, times dx.
  GSF_HOST_DEVICE T slope(int axis, int node) const {
    return node == 0 ? f[axis] - T(1.5) : (node == 1 ? T(-2) * (f[axis] - T(1)) : f[axis] - T(0.5));
  }
};

// Half-open range of nodes that `base` may take; `u` outside of it (NaN included) yields no
// stencil.
struct NodeRange {
  int32_t lo[3];
  int32_t hi[3];
};

// False, and nothing usable in `s`, when the position is not finite or its base lies outside
// `range`. The comparison comes before the cast, so no value can overflow the integer.
template <typename T>
GSF_INLINE bool make_stencil(const T* x, T inv_dx, const NodeRange& range, Stencil<T>& s) {
  for (int axis = 0; axis < 3; ++axis) {
    const T g = x[axis] * inv_dx;
    const T u = g - T(0.5);
    if (!(u >= T(range.lo[axis]) && u < T(range.hi[axis]))) return false;
    int32_t base = static_cast<int32_t>(u);
    base -= T(base) > u ? 1 : 0;  // floor: the cast truncates towards zero
    const T f = g - T(base);
    const T a = T(1.5) - f, b = f - T(1), c = f - T(0.5);
    s.base[axis] = base;
    s.f[axis] = f;
    s.w[axis][0] = T(0.5) * a * a;
    s.w[axis][1] = T(0.75) - b * b;
    s.w[axis][2] = T(0.5) * c * c;
  }
  return true;
}

// f(i, j, k) for the 27 nodes of a stencil.
template <typename F>
GSF_INLINE void for_each_node(const F& f) {
  // clang-format off
  GSF_UNROLL
  for (int i = 0; i < 3; ++i)
    GSF_UNROLL
    for (int j = 0; j < 3; ++j)
      GSF_UNROLL
      for (int k = 0; k < 3; ++k) f(i, j, k);
  // clang-format on
}

}  // namespace gsf
