// Contact of points with rigid colliders: a point that is nearer to a collider than its contact
// radius is pushed out by a spring as stiff as a cell of its own matter. No torch, no loops.
//
// The force is the gradient of an energy that depends on the place of the point alone, so it gives
// back what it took: a node that is held takes the speed of its mass away for good, half a cell of
// it for every face that lands. Colliders then act where the points are, not where nodes happen to
// lie. docs/theory/colliders.md, "At a point".
#pragma once

#include "core/collider/collider.h"

namespace gsf {

// Largest (frequency of the spring times dt)^2; 4 would be unstable, and 1 already shows.
constexpr double kSpringStep = 0.25;
// Damping of the springs in periods of a cell's wave, so that what stands on them comes to rest: a
// body that chatters is not held by friction.
constexpr double kSpringDamping = 0.1;
// Depth [cells] from which on the force does not grow.
constexpr double kSpringDepth = 1.0;
// Depths [cells] between which a point comes to lose all of its approach in a step: what is faster
// than its own waves would outrun a spring. Only what lands above a third of their speed gets
// there, and loses it in its own shock as well.
constexpr double kSpringBrake = 0.5, kSpringStop = 0.75;
// Nodes so deep [cells] inside are held as without springs: what came through them is stopped.
constexpr double kSpringNode = 1.25;
// Furthest [cells] from the surface at which a point can be pushed, radius included.
constexpr double kSpringReach = 0.5;

// Whether a valid collider pushes points. Those with mass share an impact with nodes, sweeping ones
// look ahead along the path of nodes, faces of blades act on sides of nodes: these hold nodes.
template <typename T>
GSF_HOST_DEVICE bool collider_springs(const T* row) {
  return row[kType] != T(kNothing) && row[kType] != T(kFace) && row[kMode] == T(2) &&
         row[kMass] == T(0) && row[kSweep] == T(0) && row[kOnlyCut] == T(0);
}

// Speed [m/s] that a point gets along the normal in a step: `depth` [m] is how far it is nearer
// than its radius, `wave` the speed of its P-wave, `length` the cube root of its volume, `longest`
// a step [s] that no step exceeds, `times` what the collider is stiffer: a slow press sinks in that
// much less, and a blow leaves more that the transfer takes.
template <typename T>
GSF_HOST_DEVICE T spring_speed(T depth, T wave, T length, T dx, T dt, T longest, T times) {
  const T rate = min(wave * wave / (dx * length), T(kSpringStep) / (longest * longest));
  return dt * times * rate * min(depth, T(kSpringDepth) * dx);
}

// Share of its approach that a point at this depth [m] loses in a step at least.
template <typename T>
GSF_HOST_DEVICE T spring_stop(T depth, T dx) {
  return clamp((depth / dx - T(kSpringBrake)) / T(kSpringStop - kSpringBrake), T(0), T(1));
}

// Time [s] by which a spring's force is ahead of its depth: what it gives back less than it took.
GSF_HOST_DEVICE double spring_lag(double wave, double dx) {
  return kSpringDamping * dx / max(wave, 1e-30);
}

// Coulomb friction at a node that got the impulse `push` [N s] of springs: v loses up to
// `limit` / `mass` of its speed along the surface of a collider whose matter moves with `own`.
template <typename T>
GSF_HOST_DEVICE Vec3<T> spring_friction(const Vec3<T>& v, const Vec3<T>& own, const Vec3<T>& push,
                                        T limit, T mass) {
  const T length = norm(push);
  if (!(length > T(0))) return v;
  const Vec3<T> n = (T(1) / length) * push, u = v - own;
  const Vec3<T> slip = u - dot(u, n) * n;
  const T speed = norm(slip);
  if (!(speed > T(0))) return v;
  return v - (min(limit / mass, speed) / speed) * slip;
}

}  // namespace gsf
