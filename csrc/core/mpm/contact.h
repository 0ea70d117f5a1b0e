// What happens at one grid node where two bodies meet: the normal they share, whether they touch,
// the impulse between them. No torch, no loops over nodes. Rigid colliders:
// core/collider/collider.h.
//
// LAYOUT. Per node and body the transfer accumulates mass, momentum and kContactMoments sums, the
// first moment of the mass about the node in cells [kg], each an order-independent sum over
// particles:
//
//   moment[k] = sum_p w m (x_p - x_node)[k] / dx        (contact_moment; |moment[k]| <= 1.5 mass)
//
// A node reads these of itself and of its 26 neighbours, of two bodies, through an accessor
//
//   ContactSample<T> near(int side, int o)      side 0 = body a, 1 = body b
//                                               o = 0..26: node + (o / 9 - 1, o / 3 % 3 - 1, o % 3
//                                               - 1); 13 is the node itself
//
// with mass 0 where the body has no mass or its moments are not stored (a grid that stores moments
// only in blocks where two bodies meet should also store them in the blocks around those: a sample
// left out costs accuracy of the normal, never safety). Pairs of fields that are parts of one
// unbroken body are not contacts: merge_group after all contacts of the node.
//
// NORMAL. The centroid x_node + dx moment / mass of a neighbour's sum lies inside the body, as far
// out as the body reaches there. Two bodies that do not overlap can be parted by a plane, and so
// can these centroids: a normal is as good as the gap it leaves between them. Three normals are
// tried: the outward direction of either body, from moments smoothed over the neighbours, and their
// mean. The mean is best where both surfaces are smooth, so it wins ties; one body's own direction
// is taken where it parts the bodies clearly better (at the edge of a footprint, where the other
// body's direction leans). docs/theory/contact.md compares this with other normals.
// Source of the force: equations.md 11.3 (corrected Collision-MPM); Bardenhagen et al. 2001. Idea
// of a separating plane: Nairn et al. 2020.
#pragma once

#include "core/mpm/grid.h"

namespace gsf {

constexpr int kContactMoments = 3;

// Nodes lighter than this carry no velocity. B-spline nodal mass and momentum shrink together, so
// the quotient is accurate down to the smallest normal numbers; the floor only keeps 0 / 0 and
// denormals out.
template <typename T>
GSF_HOST_DEVICE T mass_floor() {
  return T(1e-30);
}

struct ContactLaw {
  double friction;  // Coulomb coefficient between bodies
  // 0: no approach velocity is left; 1: elastic. Makes energy in a contact of many steps: the
  // resident solver has none (docs/theory/contact.md).
  double restitution;
  double gap;  // s_c: centroid separation, in dx, up to which bodies touch
};

// Sums of one body at one node.
template <typename T>
struct ContactSample {
  T mass;          // kg
  Vec3<T> moment;  // sum w m (x_p - x_node) / dx [kg]
};

// What a particle adds to stencil node (i, j, k): `weighted` = w m.
template <typename T>
GSF_HOST_DEVICE Vec3<T> contact_moment(const Stencil<T>& s, T weighted, int i, int j, int k) {
  return {weighted * (s.f[0] - T(i)), weighted * (s.f[1] - T(j)), weighted * (s.f[2] - T(k))};
}

GSF_HOST_DEVICE int neighbour_step(int o, int axis) {
  return (axis == 0 ? o / 9 : (axis == 1 ? o / 3 % 3 : o % 3)) - 1;
}

// Outward direction of one body, smoothed over the neighbours; `largest` = the heaviest of them.
template <typename T, typename Near>
GSF_HOST_DEVICE bool contact_direction(const Near& near, int side, Vec3<T>& out, T& largest) {
  Vec3<T> sum{T(0), T(0), T(0)};
  largest = T(0);
  for (int o = 0; o < 27; ++o) {
    const ContactSample<T> s = near(side, o);
    T weight = T(1);
    for (int axis = 0; axis < 3; ++axis) weight *= neighbour_step(o, axis) == 0 ? T(1) : T(0.5);
    sum = sum - weight * s.moment;
    largest = max(largest, s.mass);
  }
  const T length = norm(sum);
  // Also false for NaN.
  if (!(length > T(1e-6) * largest)) return false;
  out = (T(1) / length) * sum;
  return true;
}

// Unit normal out of body a (into b); false when the moments say nothing.
template <typename T, typename Near>
GSF_HOST_DEVICE bool contact_normal(const Near& near, Vec3<T>& normal) {
  Vec3<T> direction[2];
  T largest[2];
  const bool known_a = contact_direction(near, 0, direction[0], largest[0]);
  const bool known_b = contact_direction(near, 1, direction[1], largest[1]);
  if (!known_a && !known_b) return false;
  if (!known_a || !known_b) {
    normal = known_a ? direction[0] : T(-1) * direction[1];
    return true;
  }
  Vec3<T> candidate[3] = {direction[0] - direction[1], direction[0], T(-1) * direction[1]};
  const T length = norm(candidate[0]);
  // The directions agree: one body wraps a thin part of the other; let the gap choose.
  const bool opposed = length >= T(0.1);
  candidate[0] = opposed ? (T(1) / length) * candidate[0] : direction[0];
  // Width of the gap each candidate leaves between the centroids of the two bodies, in cells.
  constexpr T kFar = T(16);
  T reach[3] = {-kFar, -kFar, -kFar}, start[3] = {kFar, kFar, kFar};
  for (int side = 0; side < 2; ++side)
    for (int o = 0; o < 27; ++o) {
      const ContactSample<T> s = near(side, o);
      // Far lighter nodes may have a centroid of round-off.
      if (!(s.mass > T(1e-4) * largest[side])) continue;
      const T inverse = T(1) / s.mass;
      const Vec3<T> x{T(neighbour_step(o, 0)) + inverse * s.moment.x,
                      T(neighbour_step(o, 1)) + inverse * s.moment.y,
                      T(neighbour_step(o, 2)) + inverse * s.moment.z};
      for (int c = 0; c < 3; ++c) {
        const T along = dot(x, candidate[c]);
        if (side == 0)
          reach[c] = max(reach[c], along);
        else
          start[c] = min(start[c], along);
      }
    }
  const T gap[3] = {start[0] - reach[0], start[1] - reach[1], start[2] - reach[2]};
  const bool second = gap[2] > gap[1];
  const T better = (second ? gap[2] : gap[1]) - gap[0];
  // From 0.1 to 0.2 cells, the roughness of a surface of 8 particles per cell, the mean gives way.
  const T share = opposed ? clamp((better - T(0.1)) * T(10), T(0), T(1)) : T(better > T(0));
  const Vec3<T> mixed =
      candidate[0] + share * ((second ? candidate[2] : candidate[1]) - candidate[0]);
  const T size = norm(mixed);
  if (!(size > T(0.1))) return false;
  normal = (T(1) / size) * mixed;
  return true;
}

// Impulse between bodies a and b at one node; returns whether they touch. Momentum is exchanged,
// never made: v_a -= j / m_a, v_b += j / m_b with one j.
template <typename T, typename Near>
GSF_HOST_DEVICE bool contact_pair(const Near& near, const ContactLaw& law, Vec3<T>& v_a,
                                  Vec3<T>& v_b) {
  const ContactSample<T> a = near(0, 13), b = near(1, 13);
  const Vec3<T> relative = v_a - v_b;
  if (!(dot(relative, relative) > T(0))) return false;
  Vec3<T> n;
  if (!contact_normal(near, n)) return false;
  const Vec3<T> separation = (T(1) / b.mass) * b.moment - (T(1) / a.mass) * a.moment;
  if (!(dot(separation, n) <= T(law.gap))) return false;
  const T approach = dot(relative, n);
  if (!(approach > T(0))) return false;
  // m_a m_b / (m_a + m_b) without the product, which underflows for light nodes.
  const T reduced = a.mass / (a.mass + b.mass) * b.mass;
  const T normal_impulse = (T(1) + T(law.restitution)) * reduced * approach;
  const Vec3<T> slip = relative - approach * n;
  const T slip_speed = norm(slip);
  const T slip_impulse = min(T(law.friction) * normal_impulse, reduced * slip_speed);
  Vec3<T> impulse = normal_impulse * n;
  if (slip_speed > T(0)) impulse = impulse + (slip_impulse / slip_speed) * slip;
  v_a = v_a - (T(1) / a.mass) * impulse;
  v_b = v_b + (T(1) / b.mass) * impulse;
  return true;
}

// Fields that are parts of one body (the set bits of `members`): the velocity they would have as
// one field. mass(f), velocity(f), store(f, v).
template <typename T, typename Mass, typename Velocity, typename Store>
GSF_HOST_DEVICE void merge_group(uint64_t members, const Mass& mass, const Velocity& velocity,
                                 const Store& store) {
  if ((members & (members - 1)) == 0) return;
  T total = T(0);
  for (int f = 0; f < 64; ++f)
    if (members >> f & 1u) total += mass(f);
  if (!(total > T(0))) return;
  Vec3<T> common{T(0), T(0), T(0)};
  for (int f = 0; f < 64; ++f)
    if (members >> f & 1u) common = common + (mass(f) / total) * velocity(f);
  for (int f = 0; f < 64; ++f)
    if (members >> f & 1u) store(f, common);
}

}  // namespace gsf
