// Sparse grid of 4x4x4-node blocks: look-up, what one particle gives to the grid and takes from it.
// No loops over particles. Source: equations.md section 8 (MLS-MPM, Hu et al. 2018; APIC, Jiang et
// al. 2015).
#pragma once

#include "core/mpm/bspline.h"

namespace gsf {

constexpr int kBlockEdge = 4;
constexpr int kBlockNodes = 64;
constexpr int kMaxFields = 64;

GSF_HOST_DEVICE int32_t block_of(int32_t node) { return node >> 2; }
GSF_HOST_DEVICE int32_t local_of(int32_t node) { return node & 3; }
// Block coordinate `step` blocks on; one that wraps is in no table.
GSF_HOST_DEVICE int32_t beside(int32_t block, int32_t step) {
  return static_cast<int32_t>(static_cast<uint32_t>(block) + static_cast<uint32_t>(step));
}
GSF_HOST_DEVICE int32_t local_index(int32_t i, int32_t j, int32_t k) { return (i * 4 + j) * 4 + k; }

// What build_blocks made, as pointers. Nothing read through it is trusted: every index is checked
// before use.
struct BlockView {
  const int32_t* table;   // [size[0], size[1], size[2]] active block or -1
  const int32_t* coords;  // [count, 3]
  const int32_t* order;   // [particles]
  const int32_t* start;   // [count + 1]
  int32_t origin[3];
  int32_t size[3];
  int64_t count;
  int64_t particles;
  int32_t margin;

  // Active block at block coordinates (x, y, z), -1 when there is none.
  GSF_HOST_DEVICE int32_t at(int32_t x, int32_t y, int32_t z) const {
    const int64_t i = int64_t(x) - origin[0], j = int64_t(y) - origin[1],
                  k = int64_t(z) - origin[2];
    if (i < 0 || j < 0 || k < 0 || i >= size[0] || j >= size[1] || k >= size[2]) return -1;
    const int32_t b = table[(i * size[1] + j) * size[2] + k];
    return b >= 0 && b < count ? b : -1;
  }

  GSF_HOST_DEVICE NodeRange node_range() const {
    NodeRange r;
    for (int axis = 0; axis < 3; ++axis) {
      r.lo[axis] = origin[axis] * kBlockEdge;
      r.hi[axis] = (origin[axis] + size[axis]) * kBlockEdge;
    }
    return r;
  }
};

// The (up to) eight blocks under one stencil: flat node index of stencil node (i, j, k), -1 blocks
// make it uncovered.
struct StencilBlocks {
  int32_t block[2][2][2];
  int32_t lo[3];

  template <typename T>
  GSF_HOST_DEVICE bool find(const BlockView& view, const Stencil<T>& s) {
    int32_t hi[3];
    for (int axis = 0; axis < 3; ++axis) {
      lo[axis] = block_of(s.base[axis]);
      hi[axis] = block_of(s.base[axis] + 2);
    }
    bool covered = true;
    for (int a = 0; a < 2; ++a)
      for (int b = 0; b < 2; ++b)
        for (int c = 0; c < 2; ++c) {
          block[a][b][c] = view.at(a ? hi[0] : lo[0], b ? hi[1] : lo[1], c ? hi[2] : lo[2]);
          covered = covered && block[a][b][c] >= 0;
        }
    return covered;
  }

  template <typename T>
  GSF_HOST_DEVICE int64_t node(const Stencil<T>& s, int i, int j, int k) const {
    const int32_t x = s.base[0] + i, y = s.base[1] + j, z = s.base[2] + k;
    // Selects instead of an index: the array stays in registers on the device.
    const bool far_x = block_of(x) != lo[0], far_y = block_of(y) != lo[1],
               far_z = block_of(z) != lo[2];
    const int32_t near_near = far_x ? block[1][0][0] : block[0][0][0];
    const int32_t near_far = far_x ? block[1][0][1] : block[0][0][1];
    const int32_t far_near = far_x ? block[1][1][0] : block[0][1][0];
    const int32_t far_far = far_x ? block[1][1][1] : block[0][1][1];
    const int32_t b = far_y ? (far_z ? far_far : far_near) : (far_z ? near_far : near_near);
    return int64_t(b) * kBlockNodes + local_index(local_of(x), local_of(y), local_of(z));
  }
};

// Field and stencil of particle p of a kernel's arguments, and the blocks under it; p is not looked
// at unless it exists. False when it has no place, because it is in no field, or active blocks do
// not cover its stencil: then it gives nothing and takes nothing.
template <class Args, typename T>
GSF_INLINE bool locate_particle(const Args& a, bool exists, int64_t p, int32_t& field,
                                Stencil<T>& s, StencilBlocks& at) {
  field = exists && a.body != nullptr ? a.body[p] : 0;
  return exists && field >= 0 && field < a.fields &&
         make_stencil(a.position + 3 * p, T(1) / a.dx, a.blocks.node_range(), s) &&
         at.find(a.blocks, s);
}

// Momentum one particle gives to stencil node o (o in {0, 1, 2}^3), before its weight: constant +
// slope o. MLS-MPM: m (v + C d) - dt V0 (4 / dx^2) tau d with d = x_i - x_p = (o - f) dx.
template <typename T>
struct ParticleMomentum {
  Vec3<T> constant;
  Mat3<T> slope;
  T mass;
};

template <typename T>
GSF_HOST_DEVICE ParticleMomentum<T> particle_momentum(const Stencil<T>& s, T mass,
                                                      const T* velocity, const T* affine,
                                                      const T* stress, T volume, T dx, T dt) {
  ParticleMomentum<T> q;
  for (int i = 0; i < 9; ++i) q.slope.m[i] = mass * affine[i];
  if (stress != nullptr) {
    const T scale = -dt * volume * T(4) / (dx * dx);
    const Mat3<T> tau = to_mat3(load_sym3(stress));
    for (int i = 0; i < 9; ++i) q.slope.m[i] += scale * tau.m[i];
  }
  for (int i = 0; i < 9; ++i) q.slope.m[i] *= dx;
  for (int i = 0; i < 3; ++i)
    q.constant[i] = mass * velocity[i] -
                    (q.slope(i, 0) * s.f[0] + q.slope(i, 1) * s.f[1] + q.slope(i, 2) * s.f[2]);
  q.mass = mass;
  return q;
}

// What one particle gathers: value = sum w g (four channels) and first = sum w g (x_i - x_p)^T
// (three channels).
template <typename T>
struct Gathered {
  T value[4];
  Mat3<T> first;
};

// APIC update of one particle: v' = sum w v_i, C' = (4 / dx^2) sum w v_i d^T, x' = x + dt v', F' =
// (I + dt C') F.
template <typename T>
GSF_HOST_DEVICE void finish_g2p(const Gathered<T>& g, T dx, T dt, const T* x, const T* deformation,
                                T* x_out, T* v_out, T* affine_out, T* deformation_out) {
  const T scale = T(4) / (dx * dx);
  Mat3<T> c;
  for (int i = 0; i < 9; ++i) c.m[i] = scale * g.first.m[i];
  store_mat3(affine_out, c);
  for (int i = 0; i < 3; ++i) {
    v_out[i] = g.value[i];
    x_out[i] = x[i] + dt * g.value[i];
  }
  if (deformation != nullptr) {
    const Mat3<T> f = load_mat3(deformation);
    store_mat3(deformation_out, f + dt * matmul(c, f));
  }
}

// A particle the blocks do not cover keeps its velocity, loses C and flies on; a non-finite
// position stays as it is.
template <typename T>
GSF_HOST_DEVICE void skip_g2p(T dt, const T* x, const T* velocity, const T* deformation, T* x_out,
                              T* v_out, T* affine_out, T* deformation_out) {
  for (int i = 0; i < 3; ++i) {
    const T v = velocity != nullptr ? velocity[i] : T(0);
    v_out[i] = v;
    x_out[i] = x[i] + dt * v;
  }
  for (int i = 0; i < 9; ++i) affine_out[i] = T(0);
  if (deformation != nullptr)
    for (int i = 0; i < 9; ++i) deformation_out[i] = deformation[i];
}

}  // namespace gsf
