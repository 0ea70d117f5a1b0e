// What happens at one grid node: momentum to velocity, contact between two bodies. No torch, no
// loops over nodes. Source: equations.md 11.3 (corrected Collision-MPM force); Bardenhagen et al.
// 2001. Rigid colliders: core/collider.h.
#pragma once

#include "core/grid.h"

namespace gsf {

// Nodes lighter than this carry no velocity. B-spline nodal mass and momentum shrink together, so
// the quotient is accurate down to the smallest normal numbers; the floor only keeps 0 / 0 and
// denormals out.
template <typename T>
GSF_HOST_DEVICE T mass_floor() {
  return T(1e-30);
}

struct ContactLaw {
  double friction;     // Coulomb coefficient between bodies
  double restitution;  // 0: no approach velocity is left; 1: elastic
  double gap;          // s_c: centroid separation, in dx, up to which bodies touch
};

// Unit normal pointing out of body a (into b); false when neither mass gradient says anything.
template <typename T>
GSF_HOST_DEVICE bool contact_normal(T mass_a, T mass_b, const Vec3<T>& grad_a,
                                    const Vec3<T>& grad_b, T dx, Vec3<T>& normal) {
  const T len_a = norm(grad_a), len_b = norm(grad_b);
  const T sharp_a = len_a * dx / mass_a, sharp_b = len_b * dx / mass_b;
  const T floor = T(1e-6);
  // Written so that NaN in the moments means "no contact".
  if (!(sharp_a >= floor || sharp_b >= floor)) return false;
  const Vec3<T> unit_a = (sharp_a >= floor ? T(1) / len_a : T(0)) * grad_a;
  const Vec3<T> unit_b = (sharp_b >= floor ? T(1) / len_b : T(0)) * grad_b;
  const Vec3<T> d = unit_a - unit_b;
  const T len = norm(d);
  if (len >= T(0.1)) {
    normal = (T(1) / len) * d;
  } else {  // gradients agree (a thin body wrapped by the other): trust the sharper one
    normal = sharp_a >= sharp_b ? unit_a : T(-1) * unit_b;
  }
  return true;
}

// Impulse between bodies a and b at one node; returns whether they touch. `first` = sum w m (x_p -
// x_node). Momentum is exchanged, never made: v_a -= j / m_a, v_b += j / m_b with one j.
template <typename T>
GSF_HOST_DEVICE bool contact_pair(T mass_a, T mass_b, const T* moments_a, const T* moments_b, T dx,
                                  const ContactLaw& law, Vec3<T>& v_a, Vec3<T>& v_b) {
  Vec3<T> n;
  const Vec3<T> grad_a{moments_a[0], moments_a[1], moments_a[2]};
  const Vec3<T> grad_b{moments_b[0], moments_b[1], moments_b[2]};
  if (!contact_normal(mass_a, mass_b, grad_a, grad_b, dx, n)) return false;
  const Vec3<T> separation{moments_b[3] / mass_b - moments_a[3] / mass_a,
                           moments_b[4] / mass_b - moments_a[4] / mass_a,
                           moments_b[5] / mass_b - moments_a[5] / mass_a};
  if (!(dot(separation, n) <= T(law.gap) * dx)) return false;
  const Vec3<T> relative = v_a - v_b;
  const T approach = dot(relative, n);
  if (!(approach > T(0))) return false;
  // m_a m_b / (m_a + m_b) without the product, which underflows for light nodes.
  const T reduced = mass_a / (mass_a + mass_b) * mass_b;
  const T normal_impulse = (T(1) + T(law.restitution)) * reduced * approach;
  const Vec3<T> slip = relative - approach * n;
  const T slip_speed = norm(slip);
  const T slip_impulse = min(T(law.friction) * normal_impulse, reduced * slip_speed);
  Vec3<T> impulse = normal_impulse * n;
  if (slip_speed > T(0)) impulse = impulse + (slip_impulse / slip_speed) * slip;
  v_a = v_a - (T(1) / mass_a) * impulse;
  v_b = v_b + (T(1) / mass_b) * impulse;
  return true;
}

}  // namespace gsf
