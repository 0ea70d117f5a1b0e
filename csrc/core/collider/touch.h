// Contact of points with points of other bodies: a body is where a smooth kernel finds its volume,
// and a point that finds more of another body than it would at touching is pushed out of it. No
// torch, no loops.
//
// The forces are the gradient of an energy of the places of the points alone,
//
//   E = sum_p V_p K_p / 2 max(0, f_p - f(r_p))^2,   f_p = sum_q V_q W(x_p - x_q),
//
// with q over the points of other bodies. It depends on differences of places only and on their
// lengths, so momentum and angular momentum are exchanged and never made, and what was taken is
// given back. docs/theory/contact.md, "At a point". Kernel: Mueller et al. 2003.
#pragma once

#include "core/vec.h"

namespace gsf {

// Support of the kernel [cells]: two spacings of 8 points per cell, which it sees as a smooth body.
constexpr double kTouchReach = 1.0;
// Largest (frequency times dt)^2 of the spring of a point, half of that of both bodies.
constexpr double kTouchStep = 0.125;
// How fast the share of a half space falls a quarter of a cell outside of it [1 / cells], where the
// points of a lattice of 8 per cell touch. Its steepest is 1.23.
constexpr double kTouchSlope = 0.9505078196525574;
// Centroid distance [cells] up to which nodes of such bodies touch as without: what is pressed or
// bounces below a quarter of its wave speed stays further apart, and what is faster would go on
// through, after which normals point the wrong way.
constexpr double kTouchGap = 0.4;

// Kernel at the squared distance r2 in [0, 1] [1 / cells^3].
GSF_HOST_DEVICE double touch_kernel(double r2) {
  const double u = 1.0 - r2;
  return 1.5666814710608448 * u * u * u;  // 315 / (64 pi)
}
// Its gradient over the vector [1 / cells^5].
GSF_HOST_DEVICE double touch_gradient(double r2) {
  const double u = 1.0 - r2;
  return -6.0 * 1.5666814710608448 * u * u;
}
// Share of a half space that is found at the distance `outside` [cells] of it; beyond 0.9 cells it
// goes on as a line, since rough bodies are denser than whole in places.
GSF_HOST_DEVICE double touch_share(double outside) {
  const double s = clamp(outside, -0.9, 0.9), s2 = s * s;
  const double odd =
      s * (1.0 + s2 * (-4.0 / 3.0 + s2 * (6.0 / 5.0 + s2 * (-4.0 / 7.0 + s2 / 9.0))));
  return 0.5 - 315.0 / 256.0 * odd + (s - outside);
}

// Stiffness K of a point [Pa]: half of a cell of its matter in its way, the other half being that
// of the points it meets. `wave` [m/s] and `density` [kg/m^3] of its matter, `length` [m] the cube
// root of its volume, `longest` a step [s] that no step exceeds.
GSF_HOST_DEVICE double touch_stiffness(double density, double wave, double length, double dx,
                                       double longest) {
  const double rate = min(0.5 * wave * wave / (dx * length), kTouchStep / (longest * longest));
  return density * rate * dx * dx / (kTouchSlope * kTouchSlope);
}

// Impulse [N s] that friction takes from the faster of two bodies at a node: at most `limit` along
// their faces, and no more than stops the slip. `push` is what the springs gave to the one body
// less what they gave to the other, `relative` its velocity less that of the other.
GSF_HOST_DEVICE Vec3<double> touch_friction(const Vec3<double>& push, const Vec3<double>& relative,
                                            double limit, double reduced_mass) {
  const double length = norm(push);
  if (!(length > 0.0)) return {0.0, 0.0, 0.0};
  const Vec3<double> n = (1.0 / length) * push;
  const Vec3<double> slip = relative - dot(relative, n) * n;
  const double speed = norm(slip);
  if (!(speed > 0.0)) return {0.0, 0.0, 0.0};
  return (min(limit, reduced_mass * speed) / speed) * slip;
}

}  // namespace gsf
