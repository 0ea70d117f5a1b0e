// One particle against a dense tile of nodes: four lanes are one node. Used by the transfers
// (mpm.cpp) and by the resident solver.
#pragma once

#include "core/mpm/grid.h"

namespace gsf::cpu {

// Four lanes, one node: (px, py, pz, m). gcc and clang turn it into one SSE / AVX register.
template <typename T>
struct LanesOf;
template <>
struct LanesOf<float> {
  typedef float type __attribute__((vector_size(16)));
};
template <>
struct LanesOf<double> {
  typedef double type __attribute__((vector_size(32)));
};
template <typename T>
using Lanes = typename LanesOf<T>::type;

// Adds one particle to a tile; `node` is the base of its stencil, `edge` the nodes per axis.
template <typename T>
void scatter_momentum(const ParticleMomentum<T>& q, const Stencil<T>& s, Lanes<T>* node,
                      int32_t edge) {
  const Lanes<T> q0{q.constant.x, q.constant.y, q.constant.z, q.mass};
  const Lanes<T> qx{q.slope(0, 0), q.slope(1, 0), q.slope(2, 0), T(0)};
  const Lanes<T> qy{q.slope(0, 1), q.slope(1, 1), q.slope(2, 1), T(0)};
  const Lanes<T> qz{q.slope(0, 2), q.slope(1, 2), q.slope(2, 2), T(0)};
  Lanes<T> px = q0;
  for (int i = 0; i < 3; ++i, px += qx, node += edge * edge) {
    Lanes<T> pxy = px;
    for (int j = 0; j < 3; ++j, pxy += qy) {
      const T w = s.w[0][i] * s.w[1][j];
      Lanes<T>* n = node + j * edge;
      const Lanes<T> a = w * pxy, b = w * qz;
      n[0] += s.w[2][0] * a;
      n[1] += s.w[2][1] * (a + b);
      n[2] += s.w[2][2] * (a + b + b);
    }
  }
}

// First moment of the mass about the node, for contact.
template <typename T>
void scatter_moments(const Stencil<T>& s, T mass, Lanes<T>* node, int32_t edge) {
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      const T w = mass * s.w[0][i] * s.w[1][j];
      Lanes<T>* n = node + (i * edge + j) * edge;
      for (int k = 0; k < 3; ++k) {
        const Vec3<T> m = contact_moment(s, w * s.w[2][k], i, j, k);
        n[k] += Lanes<T>{m.x, m.y, m.z, T(0)};
      }
    }
}

// sum w g and sum w g (x_i - x_p)^T over a tile or over 27 loose nodes.
template <typename T>
Gathered<T> gather(const Stencil<T>& s, T dx, const Lanes<T>* node, int32_t edge) {
  Lanes<T> sum{}, sx{}, sy{}, sz{};
  for (int i = 0; i < 3; ++i) {
    Lanes<T> plane{};
    for (int j = 0; j < 3; ++j) {
      const Lanes<T>* n = node + (i * edge + j) * edge;
      const Lanes<T> b = s.w[2][1] * n[1], c = s.w[2][2] * n[2];
      const Lanes<T> row = s.w[2][0] * n[0] + b + c;
      const T w = s.w[1][j];
      plane += w * row;
      sy += (s.w[0][i] * w * (T(j) - s.f[1])) * row;
      sz += (s.w[0][i] * w) * (b + c + c);
    }
    sum += s.w[0][i] * plane;
    sx += (s.w[0][i] * (T(i) - s.f[0])) * plane;
  }
  sz -= s.f[2] * sum;
  Gathered<T> g;
  for (int c = 0; c < 4; ++c) g.value[c] = sum[c];
  for (int c = 0; c < 3; ++c) {
    g.first(c, 0) = dx * sx[c];
    g.first(c, 1) = dx * sy[c];
    g.first(c, 2) = dx * sz[c];
  }
  return g;
}

}  // namespace gsf::cpu
