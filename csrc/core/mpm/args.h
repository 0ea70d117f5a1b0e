// One plain struct per MPM kernel: pointers, sizes, scalars. Shared by the CPU and the CUDA back
// end.
#pragma once

#include "core/collider/collider.h"
#include "core/mpm/contact.h"

namespace gsf {

// Blocks per ordered partial sum of collider impulses; fixed, so that sums do not depend on the
// machine.
constexpr int64_t kChunkBlocks = 16;
GSF_HOST_DEVICE int64_t grid_update_chunks(int64_t blocks) {
  return (blocks + kChunkBlocks - 1) / kChunkBlocks;
}

template <typename T>
struct P2GArgs {
  BlockView blocks;
  const T* position;    // [N, 3] m
  const T* velocity;    // [N, 3] m/s
  const T* affine;      // [N, 3, 3] 1/s
  const T* mass;        // [N] kg
  const T* stress;      // [N, 6] Kirchhoff stress, Pa, or null
  const T* volume;      // [N] initial volume, m^3, or null (with stress)
  const int32_t* body;  // [N] field of each particle, or null (all 0)
  T dx, dt;
  int32_t fields;
  T* grid;           // [fields, count, 64, 4] momentum and mass, zeroed
  T* moments;        // [fields, count, 64, kContactMoments] zeroed; or null
  int64_t* skipped;  // [] particles given to no node, zeroed
};

// Gather of velocities (g2p) or of four plain channels (adjoint of p2g; derivative of a transfer
// with respect to the particle position), told apart by which outputs are set.
template <typename T>
struct GatherArgs {
  BlockView blocks;
  const T* grid;  // [fields, count, 64, channels]
  const T* position;
  const int32_t* body;
  T dx, dt;
  int32_t fields;
  int64_t* skipped;
  // g2p (channels = 3)
  const T* velocity;     // [N, 3] kept by skipped particles, or null
  const T* deformation;  // [N, 3, 3] or null
  T* position_out;
  T* velocity_out;
  T* affine_out;
  T* deformation_out;  // or null
  // adjoint (channels = 4)
  T* value_out;  // [N, 4] sum w g
  T* first_out;  // [N, 3, 3] sum w g (x_i - x_p)^T
  // transfer_slope (channels = 4)
  const T* constant;  // [N, 4]
  const T* linear;    // [N, 3, 3]
  T* slope_out;       // [N, 3] d/dx_p of sum w g . (constant + linear (x_i - x_p))
};

template <typename T>
struct GridUpdateArgs {
  BlockView blocks;       // order, start: not used
  const int32_t* coords;  // [count, 3]
  int64_t count;
  int32_t fields;
  const T* grid;           // [fields, count, 64, 4]
  const T* moments;        // [fields, count, 64, kContactMoments] or null
  const uint64_t* merged;  // [fields] bit g of word f: f and g move as one; or null
  const int32_t* cut;      // [fields] sides of blades (core/collider/blade.h), or null: none
  const T* colliders;      // [collider_count, kColliderColumns] or null
  int64_t collider_count;
  const float* sdf;  // [sdf_count] distance grids of all colliders, or null
  int64_t sdf_count;
  T dx, dt;
  T gravity[3];
  ContactLaw law;
  T* velocity;             // [fields, count, 64, 3]
  double* partial;         // [chunks, collider_count, 6] scratch
  double* contact_mass;    // [collider_count] kg that colliders with mass touch; scratch
  double* impulse;         // [collider_count, 6] impulse and torque
  int64_t* contact_nodes;  // [] zeroed

  GSF_HOST_DEVICE const T* node(int32_t field, int64_t node) const {
    return grid + 4 * (int64_t(field) * count * kBlockNodes + node);
  }
  GSF_HOST_DEVICE T* out(int32_t field, int64_t node) const {
    return velocity + 3 * (int64_t(field) * count * kBlockNodes + node);
  }
  GSF_HOST_DEVICE int32_t cut_of(int32_t field) const { return cut != nullptr ? cut[field] : 0; }
  GSF_HOST_DEVICE void set(int32_t field, int64_t node, const Vec3<T>& v) const {
    for (int i = 0; i < 3; ++i) out(field, node)[i] = v[i];
  }
};

// What contact reads around one node of a pair of fields.
template <typename T>
struct ContactNear {
  const GridUpdateArgs<T>& a;
  int32_t field[2];
  int32_t block[3], local[3];

  GSF_HOST_DEVICE ContactNear(const GridUpdateArgs<T>& args, int64_t node)
      : a(args),
        field{0, 0},
        local{int32_t(node % kBlockNodes / 16), int32_t(node / 4 % 4), int32_t(node % 4)} {
    for (int axis = 0; axis < 3; ++axis) block[axis] = a.coords[3 * (node / kBlockNodes) + axis];
  }

  GSF_HOST_DEVICE ContactSample<T> operator()(int side, int o) const {
    const int32_t x = local[0] + neighbour_step(o, 0), y = local[1] + neighbour_step(o, 1),
                  z = local[2] + neighbour_step(o, 2);
    const int32_t b = a.blocks.at(beside(block[0], block_of(x)), beside(block[1], block_of(y)),
                                  beside(block[2], block_of(z)));
    if (b < 0) return {T(0), {T(0), T(0), T(0)}};
    const int64_t n = int64_t(b) * kBlockNodes + local_index(local_of(x), local_of(y), local_of(z));
    const T mass = a.node(field[side], n)[3];
    if (!(mass > mass_floor<T>())) return {T(0), {T(0), T(0), T(0)}};
    const T* m = a.moments + kContactMoments * (int64_t(field[side]) * a.count * kBlockNodes + n);
    return {mass, {m[0], m[1], m[2]}};
  }
};

// Fields that move with field f at this node: its group of merged fields, transitively.
template <typename T>
GSF_HOST_DEVICE uint64_t merged_group(const GridUpdateArgs<T>& a, uint64_t present, int32_t f) {
  uint64_t group = uint64_t(1) << f, before = 0;
  while (group != before) {
    before = group;
    for (int32_t g = 0; g < a.fields; ++g)
      if (before >> g & 1u) group |= a.merged[g] & present;
  }
  return group;
}

// Momentum to velocity with gravity, then contact between every pair of fields (Gauss-Seidel), then
// fields that are merged to their common velocity; returns whether any touched.
template <typename T>
GSF_HOST_DEVICE bool update_node(const GridUpdateArgs<T>& a, int64_t node) {
  uint64_t present = 0;
  for (int32_t f = 0; f < a.fields; ++f) {
    const T* g = a.node(f, node);
    T* v = a.out(f, node);
    const bool heavy = g[3] > mass_floor<T>();
    for (int i = 0; i < 3; ++i) v[i] = heavy ? g[i] / g[3] + a.dt * a.gravity[i] : T(0);
    present |= uint64_t(heavy ? 1 : 0) << f;
  }
  if ((present & (present - 1)) == 0) return false;  // fewer than two
  bool touched = false;
  if (a.moments != nullptr) {
    ContactNear<T> near(a, node);
    for (int32_t fa = 0; fa < a.fields; ++fa) {
      if ((present >> fa & 1u) == 0) continue;
      const uint64_t with_a = a.merged != nullptr ? merged_group(a, present, fa) : 0;
      for (int32_t fb = fa + 1; fb < a.fields; ++fb) {
        if ((present >> fb & 1u) == 0 || (with_a >> fb & 1u) != 0) continue;
        Vec3<T> va = load_vec3(a.out(fa, node)), vb = load_vec3(a.out(fb, node));
        near.field[0] = fa;
        near.field[1] = fb;
        if (!contact_pair(near, a.law, va, vb)) continue;
        touched = true;
        a.set(fa, node, va);
        a.set(fb, node, vb);
      }
    }
  }
  for (uint64_t left = a.merged != nullptr ? present : 0; left != 0;) {
    int32_t first = 0;
    while ((left >> first & 1u) == 0) ++first;
    const uint64_t group = merged_group(a, present, first);
    left &= ~group;
    merge_group<T>(
        group, [&](int32_t f) { return a.node(f, node)[3]; },
        [&](int32_t f) { return load_vec3(a.out(f, node)); },
        [&](int32_t f, const Vec3<T>& v) { a.set(f, node, v); });
  }
  return touched;
}

template <typename T>
GSF_HOST_DEVICE Vec3<T> node_position(const GridUpdateArgs<T>& a, int64_t node) {
  const int32_t* block = a.coords + 3 * (node / kBlockNodes);
  const int32_t local = static_cast<int32_t>(node % kBlockNodes);
  return {(T(block[0]) * kBlockEdge + T(local / 16)) * a.dx,
          (T(block[1]) * kBlockEdge + T(local / 4 % 4)) * a.dx,
          (T(block[2]) * kBlockEdge + T(local % 4)) * a.dx};
}

// Whether no node of a block can touch a valid collider: distances change by at most 1 per metre,
// and no node is further than sqrt(3) 1.5 dx from the middle. Not for sweeping colliders, which
// reach as far as nodes move.
template <typename T>
GSF_HOST_DEVICE bool block_clear(const GridUpdateArgs<T>& a, const T* row, int64_t block) {
  if (row[kSweep] != T(0)) return false;
  const Vec3<T> low = node_position(a, block * kBlockNodes);
  const T half = T(1.5) * a.dx;
  return collider_clearance(row, a.sdf, low + Vec3<T>{half, half, half}) > T(2.61) * a.dx;
}

// Sides that all fields share which move with field f at this node. Where one of them is not parted
// the body is whole: a face that pushed there would be undone by the merging, step after step.
template <typename T>
GSF_HOST_DEVICE int32_t group_cut(const GridUpdateArgs<T>& a, int64_t node, int32_t f) {
  if (a.cut == nullptr || a.merged == nullptr) return a.cut_of(f);
  uint64_t present = 0;
  for (int32_t g = 0; g < a.fields; ++g)
    present |= uint64_t(a.node(g, node)[3] > mass_floor<T>() ? 1 : 0) << g;
  const uint64_t group = merged_group(a, present, f);
  int32_t cut = ~int32_t(0);
  for (int32_t g = 0; g < a.fields; ++g)
    if (group >> g & 1u) cut &= a.cut[g];
  return cut;
}

// Whether collider `row` acts on field f at this node.
template <typename T>
GSF_HOST_DEVICE bool acts_at(const GridUpdateArgs<T>& a, const T* row, int64_t node, int32_t f) {
  return row[kOnlyCut] == T(0) || collider_acts_on(row, group_cut(a, node, f));
}

// Mass of the fields at one node that touch a valid collider `row` [kg].
template <typename T>
GSF_HOST_DEVICE double touching_mass(const GridUpdateArgs<T>& a, const T* row, int64_t node) {
  const Vec3<T> x = node_position(a, node);
  double total = 0.0;
  for (int32_t f = 0; f < a.fields; ++f) {
    const T mass = a.node(f, node)[3];
    if (!(mass > mass_floor<T>()) || !acts_at(a, row, node, f)) continue;
    Vec3<T> normal;
    T share;
    if (collider_touch(row, a.sdf, x, load_vec3(a.out(f, node)), a.dx, a.dt, normal, share))
      total += double(mass);
  }
  return total;
}

// Applies a valid collider `row` to every field at one node and adds the impulse and the torque
// given to the bodies.
template <typename T>
GSF_HOST_DEVICE void collide_node(const GridUpdateArgs<T>& a, const T* row, T give, int64_t node,
                                  double* sums) {
  const Vec3<T> x = node_position(a, node);
  for (int32_t f = 0; f < a.fields; ++f) {
    const T mass = a.node(f, node)[3];
    if (!(mass > mass_floor<T>()) || !acts_at(a, row, node, f)) continue;
    T* p = a.out(f, node);
    Vec3<T> v = load_vec3(p);
    if (!collide_with(row, a.sdf, give, x, mass, a.dx, a.dt, v, sums)) continue;
    for (int i = 0; i < 3; ++i) p[i] = v[i];
  }
}

}  // namespace gsf
