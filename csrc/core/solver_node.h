// What happens at one node of a site in a step of the resident solver: sums to velocities, contact
// between fields, colliders.
#pragma once

#include "core/collider.h"
#include "core/solver_state.h"

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

// Contact between every pair of the fields at one node, in ascending field (Gauss-Seidel); returns
// how many pairs touched. near(field, o) = ContactSample of neighbour o, see core/contact.h: sums
// of other nodes, which must not be cleared before all contacts of the step are done.
template <typename T, typename Near>
GSF_HOST_DEVICE int node_contact(const SolverView<T>& s, int fields, const bool* heavy,
                                 const Near& near, Vec3<T>* velocity) {
  int touched = 0;
  for (int a = 0; a < fields; ++a) {
    if (!heavy[a]) continue;
    for (int b = a + 1; b < fields; ++b) {
      if (!heavy[b]) continue;
      const auto pair = [&](int side, int o) { return near(side == 0 ? a : b, o); };
      touched += contact_pair<T>(pair, s.contact, velocity[a], velocity[b]) ? 1 : 0;
    }
  }
  return touched;
}

// Applies every collider to one node of one field; adds the impulse given to the matter [N s].
template <typename T>
GSF_HOST_DEVICE void node_collide(const SolverView<T>& s, int64_t k, const Vec3<T>& x, double mass,
                                  Vec3<T>& v, double* impulse) {
  const T* row = s.colliders + k * kColliderColumns;
  if (!collider_valid(row, 0)) return;
  double sums[6] = {};
  if (!collide_with(row, static_cast<const float*>(nullptr), T(1), x, T(mass), s.dx, T(0), v, sums))
    return;
  for (int i = 0; i < 3; ++i) impulse[i] += sums[i];
}

}  // namespace gsf
