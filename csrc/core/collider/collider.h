// Rigid colliders at a grid node: sticky, slip, separate with Coulomb friction; how a collider
// moves. Source: equations.md section 8 (boundaries); restitution and friction after Bardenhagen et
// al. 2001. A collider with mass takes the impulse of what it hits, exactly.
#pragma once

#include "core/collider/shape.h"

namespace gsf {

// Velocity of the collider's matter at x [m/s].
template <typename T>
GSF_HOST_DEVICE Vec3<T> collider_velocity(const T* row, const Vec3<T>& x) {
  return load_vec3(row + kVelocity) +
         cross(load_vec3(row + kAngularVelocity), x - load_vec3(row + kPoint));
}

// Velocity of a node at x that touches the collider, after it. In the frame of the collider the
// speed never grows.
template <typename T>
GSF_HOST_DEVICE Vec3<T> collide(const T* row, const Vec3<T>& normal, const Vec3<T>& x,
                                const Vec3<T>& velocity) {
  const Vec3<T> own = collider_velocity(row, x);
  if (row[kMode] == T(0)) return own;
  const Vec3<T> relative = velocity - own;
  const T vn = dot(relative, normal);
  const Vec3<T> slip = relative - vn * normal;
  if (row[kMode] == T(1)) return own + slip;
  if (vn >= T(0)) return velocity;
  const T rebound = row[kRestitution];
  const T speed = norm(slip);
  const T kept = max(T(0), speed + row[kFriction] * (T(1) + rebound) * vn);
  const Vec3<T> tangential = speed > T(0) ? (kept / speed) * slip : slip;
  return own + tangential + (-rebound * vn) * normal;
}

// Whether a collider acts on a field with this `cut` (core/collider/blade.h).
template <typename T>
GSF_HOST_DEVICE bool collider_acts_on(const T* row, int32_t cut) {
  return row[kOnlyCut] == T(0) || (cut >> (static_cast<int>(row[kOnlyCut]) - 1) & 1) != 0;
}

// Whether a node at x, moving with v for dt, touches the collider; 1e-4 dx of tolerance keeps a
// node that lies on the surface inside whatever the rounding. A sweeping collider also touches what
// it would meet during the step: `share` is then the part of the step after the first touch, found
// by walking along the relative path by the signed distance, and `normal` the one there. Without
// the walk a bullet that moves further than its diameter in a step passes between nodes.
template <typename T>
GSF_HOST_DEVICE bool collider_touch(const T* row, const float* sdf, const Vec3<T>& x,
                                    const Vec3<T>& v, T dx, T dt, Vec3<T>& normal, T& share) {
  constexpr int kSteps = 32;
  share = T(1);
  T d = collider_signed_distance(row, sdf, x, normal);
  if (d <= T(1e-4) * dx) return true;
  if (row[kSweep] == T(0)) return false;
  const Vec3<T> path = dt * (v - collider_velocity(row, x));
  const T length = norm(path);
  T gone = T(0);
  for (int i = 0; i < kSteps; ++i) {
    gone += d;
    if (!(gone < length)) return false;
    d = collider_signed_distance(row, sdf, x + (gone / length) * path, normal);
    if (d <= T(1e-3) * dx) {
      share = T(1) - gone / length;
      return dot(path, normal) < T(0);
    }
  }
  return false;
}

// Part of the velocity change of `collide` that nodes of `contact_mass` kg together get from a
// collider with mass: what a plastic impact of the two masses leaves. With it the pair loses
// energy in every step, however light the collider; without it a light one would be thrown back
// faster than it came. The rotational part is bounded by the lever of the bounding ball; on a
// sphere only friction turns, and friction is at most mu / sqrt(1 + mu^2) of the force.
template <typename T>
GSF_HOST_DEVICE T collider_give(const T* row, T contact_mass) {
  const T mass = row[kMass];
  if (!(mass > T(0))) return T(1);
  T inertia = T(INFINITY);
  for (int i = 0; i < 3; ++i)
    if (row[kInertia + i] > T(0)) inertia = min(inertia, row[kInertia + i]);
  const T lever = collider_bound(row);
  T turning = mass * lever * lever / inertia;
  if (row[kType] == T(kSphere)) {
    const T mu = row[kFriction];
    if (row[kMode] == T(1)) turning = T(0);
    if (row[kMode] == T(2)) turning *= mu * mu / (T(1) + mu * mu);
  }
  return T(1) / (T(1) + contact_mass / mass * (T(1) + turning));
}

// Applies a valid collider to a node of `mass` at x; adds to sums[0..2] the impulse [N s] and to
// sums[3..5] the torque about the collider's point [N m s] given to the node, in double. Returns
// whether they touch.
template <typename T>
GSF_HOST_DEVICE bool collide_with(const T* row, const float* sdf, T give, const Vec3<T>& x, T mass,
                                  T dx, T dt, Vec3<T>& v, double* sums) {
  Vec3<T> normal;
  T share;
  if (!collider_touch(row, sdf, x, v, dx, dt, normal, share)) return false;
  Vec3<T> after = collide(row, normal, x, v);
  const T part = share * give;
  if (part != T(1)) after = v + part * (after - v);
  double j[3], r[3];
  for (int i = 0; i < 3; ++i) {
    j[i] = double(mass) * (double(after[i]) - double(v[i]));
    r[i] = double(x[i]) - double(row[kPoint + i]);
    sums[i] += j[i];
  }
  for (int i = 0; i < 3; ++i)
    sums[3 + i] += r[(i + 1) % 3] * j[(i + 2) % 3] - r[(i + 2) % 3] * j[(i + 1) % 3];
  v = after;
  return true;
}

// q turned further by the rotation vector w [rad].
template <typename T>
GSF_HOST_DEVICE void turn_further(T* q, const Vec3<T>& w) {
  using std::cos;
  using std::sin;
  using std::sqrt;
  const T angle = norm(w);
  const T s = angle > T(1e-4) ? sin(T(0.5) * angle) / angle : T(0.5) - angle * angle / T(48);
  const T c = cos(T(0.5) * angle);
  const Vec3<T> a = s * w;
  const T old[4] = {q[0], q[1], q[2], q[3]};
  const Vec3<T> b{old[1], old[2], old[3]};
  const Vec3<T> v = c * b + old[0] * a + cross(a, b);
  q[0] = c * old[0] - dot(a, b);
  for (int i = 0; i < 3; ++i) q[1 + i] = v[i];
  const T length = sqrt(q[0] * q[0] + dot(v, v));
  for (int i = 0; i < 4; ++i) q[i] /= length;
}

// Angular velocity from angular momentum (`up` false) or back, both in the world frame. An axis
// without a moment of inertia does not turn.
template <typename T>
GSF_HOST_DEVICE Vec3<T> spin(const T* row, const Vec3<T>& value, bool up) {
  Vec3<T> local = turn(row + kOrientation, value, true);
  for (int i = 0; i < 3; ++i) {
    const T moment = row[kInertia + i];
    local[i] = up ? moment * local[i] : (moment > T(0) ? local[i] / moment : T(0));
  }
  return turn(row + kOrientation, local);
}

// Moves a collider over dt. One with mass first loses the impulse [N s] and torque [N m s] that it
// gave to the bodies; it falls along its parabola and turns freely with that angular momentum
// (midpoint rule on the rotation). Call it with T = double where the
// row is kept: one step is a small change of a large number.
template <typename T>
GSF_HOST_DEVICE void advance_collider(T* row, T dt, const Vec3<T>& impulse, const Vec3<T>& torque,
                                      const Vec3<T>& gravity) {
  T* q = row + kOrientation;
  if (!(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3] > T(0))) q[0] = T(1);
  Vec3<T> velocity = load_vec3(row + kVelocity), omega = load_vec3(row + kAngularVelocity);
  const bool free = row[kMass] > T(0);
  const bool turns =
      free && (row[kInertia] > T(0) || row[kInertia + 1] > T(0) || row[kInertia + 2] > T(0));
  Vec3<T> momentum{T(0), T(0), T(0)};
  if (free) velocity = velocity - (T(1) / row[kMass]) * impulse + (T(0.5) * dt) * gravity;
  if (turns) {
    momentum = spin(row, omega, true) - torque;
    omega = spin(row, momentum, false);
    const T start[4] = {q[0], q[1], q[2], q[3]};
    turn_further(q, T(0.5) * dt * omega);
    omega = spin(row, momentum, false);
    for (int i = 0; i < 4; ++i) q[i] = start[i];
  }
  if (dot(omega, omega) > T(0)) turn_further(q, dt * omega);
  if (turns) omega = spin(row, momentum, false);
  for (int i = 0; i < 3; ++i) {
    row[kPoint + i] += dt * velocity[i];
    row[kVelocity + i] = velocity[i] + (free ? T(0.5) * dt * gravity[i] : T(0));
    row[kAngularVelocity + i] = omega[i];
  }
}

}  // namespace gsf
