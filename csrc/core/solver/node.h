// What happens at one node of a site in a step of the resident solver: sums to velocities, contact
// between fields, colliders.
#pragma once

#include "core/collider/collider.h"
#include "core/collider/touch.h"
#include "core/solver/state.h"

namespace gsf {

// Sums of one node in natural units, as both back ends hand them over.
template <typename T>
struct NodeSums {
  double mass;         // kg
  double momentum[3];  // kg m/s
};

// Velocity of a node [m/s]; false when it is too light to have one.
template <typename T>
GSF_HOST_DEVICE bool node_velocity(const SolverView<T>& s, const NodeSums<T>& sums, T dt,
                                   Vec3<T>& v) {
  const bool heavy = sums.mass > double(mass_floor<T>());
  v = {T(0), T(0), T(0)};
  if (!heavy) return false;
  const double inverse = 1.0 / sums.mass;
  for (int i = 0; i < 3; ++i) v[i] = T(sums.momentum[i] * inverse) + dt * s.gravity[i];
  return true;
}

// Neighbour o of node `local` (flat index) of a block: which of the 27 blocks around it holds it,
// and its flat index there.
GSF_HOST_DEVICE int near_block(int local, int o, int& there) {
  int block = 0;
  there = 0;
  for (int axis = 0; axis < 3; ++axis) {
    const int at = (local >> (4 - 2 * axis) & 3) + neighbour_step(o, axis);
    block = 3 * block + block_of(at) + 1;
    there = 4 * there + local_of(at);
  }
  return block;
}

// Which of the fields at one node move as one with the a-th, transitively, as bits. number(f) =
// number of the f-th.
template <typename T, typename Number>
GSF_HOST_DEVICE uint32_t node_group(const SolverView<T>& s, int fields, const bool* heavy,
                                    const Number& number, int a) {
  uint32_t group = 1u << a;
  if (s.parent == nullptr) return group;
  for (uint32_t next = group; next != 0;) {  // whom those found last know
    const uint32_t last = next;
    next = 0;
    for (int f = 0; f < fields; ++f) {
      if ((last >> f & 1u) == 0) continue;
      for (int g = 0; g < fields; ++g)
        if (heavy[g] && ((group | next) >> g & 1u) == 0 && s.moves_with(number(f), number(g)))
          next |= 1u << g;
    }
    group |= next;
  }
  return group;
}

// Sides that all fields share which move with the a-th at this node. Where one of them is not
// parted the body is whole: a face that pushed there would be undone by the merging, step after
// step.
template <typename T, typename Number>
GSF_HOST_DEVICE int32_t node_cut(const SolverView<T>& s, int fields, const bool* heavy,
                                 const Number& number, int a) {
  if (s.cut == nullptr) return 0;
  const uint32_t group = node_group(s, fields, heavy, number, a);
  int32_t cut = ~int32_t(0);
  for (int f = 0; f < fields; ++f)
    if (group >> f & 1u) cut &= s.cut_of(number(f));
  return cut;
}

// Contact between every pair of the fields at one node that do not move as one, in ascending field
// (Gauss-Seidel), then the common velocity of those that do; returns how many pairs touched.
// near(field, o) = ContactSample of neighbour o, see core/mpm/contact.h: sums of other nodes, which
// must not be cleared before all contacts of the step are done.
template <typename T, typename Number, typename Mass, typename Near>
GSF_HOST_DEVICE int node_contact(const SolverView<T>& s, int fields, const bool* heavy,
                                 const Number& number, const Mass& mass, const Near& near,
                                 Vec3<T>* velocity) {
  int touched = 0;
  for (int a = 0; a < fields; ++a) {
    if (!heavy[a]) continue;
    const uint32_t with_a = node_group(s, fields, heavy, number, a);
    for (int b = a + 1; b < fields; ++b) {
      if (!heavy[b] || (with_a >> b & 1u) != 0) continue;
      const auto pair = [&](int side, int o) { return near(side == 0 ? a : b, o); };
      ContactLaw law = s.contact;
      if (s.touches_by_points(number(a), number(b))) law.gap = kTouchGap;
      touched += contact_pair<T>(pair, law, velocity[a], velocity[b]) ? 1 : 0;
    }
  }
  if (s.parent == nullptr) return touched;
  uint32_t done = 0;
  for (int a = 0; a < fields; ++a) {
    if (!heavy[a] || (done >> a & 1u) != 0) continue;
    const uint32_t group = node_group(s, fields, heavy, number, a);
    done |= group;
    merge_group<T>(
        group, [&](int f) { return T(mass(f)); }, [&](int f) { return velocity[f]; },
        [&](int f, const Vec3<T>& v) { velocity[f] = v; });
  }
  return touched;
}

// Applies collider k to one node of one field with these sides; adds to sums what the matter got:
// impulse [N s], torque about the collider's point [N m s], touched mass [kg].
template <typename T>
GSF_HOST_DEVICE void node_collide(const SolverView<T>& s, int64_t k, const Vec3<T>& x, double mass,
                                  int32_t cut, T dt, Vec3<T>& v, double* sums) {
  const T* row = s.colliders + k * kColliderColumns;
  if (!collider_valid(row, s.sdf_count) || !collider_acts_on(row, cut)) return;
  // The mass a free collider touched a step ago stands for what it touches now.
  const T give = collider_give(row, T(s.impulse[k * kImpulseSums + 6]));
  if (collide_with(row, s.sdf, give, x, T(mass), s.dx, dt, v, sums)) sums[6] += mass;
}

// Whether collider k can touch a node of a block before the next build: nodes lie within 2.6 dx of
// the middle; the collider itself may travel one dx meanwhile, and a sweeping one is looked for one
// step ahead.
template <typename T>
GSF_HOST_DEVICE bool collider_near(const SolverView<T>& s, int64_t k, const Vec3<T>& middle) {
  const T* row = s.colliders + k * kColliderColumns;
  if (!collider_valid(row, s.sdf_count)) return false;
  const Vec3<T> omega = load_vec3(row + kAngularVelocity);
  if (!(collider_bound(row) < T(1e30)) && dot(omega, omega) > T(0)) return true;
  const T ahead = row[kSweep] != T(0)
                      ? norm(load_vec3(row + kVelocity)) * T(max(s.clock->dt, s.clock->dt_next))
                      : T(0);
  return collider_clearance(row, s.sdf, middle) <= T(5) * s.dx + ahead;
}

// Middle of a block.
template <typename T>
GSF_HOST_DEVICE Vec3<T> block_middle(const SolverView<T>& s, const int32_t* block) {
  return {(T(block[0]) * T(kBlockEdge) + T(1.5)) * s.dx,
          (T(block[1]) * T(kBlockEdge) + T(1.5)) * s.dx,
          (T(block[2]) * T(kBlockEdge) + T(1.5)) * s.dx};
}

// End of a step for collider k: what it gave is booked, it moves on; returns how far its fastest
// point moved [m].
template <typename T>
GSF_HOST_DEVICE double end_collider(const SolverView<T>& s, int64_t k, const double* sums,
                                    double dt) {
  double* total = s.impulse + k * kImpulseSums;
  double before[6];  // loads first, then stores: they need not wait for each other
  for (int i = 0; i < 6; ++i) before[i] = total[i];
  double* row = s.collider_state + k * kColliderColumns;
  const Vec3<double> v = load_vec3(row + kVelocity), w = load_vec3(row + kAngularVelocity);
  const double mass = row[kMass];
  for (int i = 0; i < 6; ++i) total[i] = before[i] + sums[i];
  total[6] = sums[6];
  const Vec3<double> gravity{double(s.gravity[0]), double(s.gravity[1]), double(s.gravity[2])};
  if (!(mass > 0.0) && dot(v, v) == 0.0 && dot(w, w) == 0.0) return 0.0;
  advance_collider(row, dt, load_vec3(sums), load_vec3(sums + 3), gravity);
  for (int i = 0; i < kColliderColumns; ++i) s.colliders[k * kColliderColumns + i] = T(row[i]);
  const double bound = collider_bound(row), turning = norm(load_vec3(row + kAngularVelocity));
  const double edge = bound < 1e30 ? bound * turning : 0.0;
  return dt * (norm(load_vec3(row + kVelocity)) + edge);
}

}  // namespace gsf
