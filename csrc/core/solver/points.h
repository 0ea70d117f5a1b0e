// What one point of the resident solver gets from the colliders and the points of other objects
// that push it (core/collider/spring.h, touch.h), and what that makes of a node. The bodies of both
// back ends' loops.
#pragma once

#include "core/collider/spring.h"
#include "core/material/loss.h"
#include "core/solver/layout.h"
#include "core/solver/node.h"

namespace gsf {

// P-wave speed of a row at rest [m/s].
template <typename T>
GSF_HOST_DEVICE double row_wave(const SolverView<T>& s, int64_t row) {
  const T* r = s.rows + row * kRowColumns;
  return double(r[kPaceColumn]) * double(r[kInverseDensityColumn]) /
         (kSlowUnloading * double(s.dx));
}

// Volume of the points of a row [m^3], and the mass that it has at its matter's density [kg]: what
// a point is pushed with hangs on the room that it takes, not on its share of the body's mass.
template <typename T>
GSF_HOST_DEVICE double row_volume(const SolverView<T>& s, int64_t row) {
  const double dx = double(s.dx);
  return 0.25 * dx * dx * double(s.rows[row * kRowColumns + kStressColumn]);
}

// Step [s] that springs of points must bear: the longest at rest, `wave` being the fastest of the
// rows. Not the present one: a spring that is stiffer in a short step gives back more than it took.
GSF_HOST_DEVICE double spring_step(const SolverClock& c, double wave, double dx) {
  return c.dt_fixed > 0.0 ? c.dt_fixed : c.cfl * dx / max(wave, 1e-30);
}

// Whether collider k pushes points.
template <typename T>
GSF_HOST_DEVICE bool pushes_points(const SolverView<T>& s, int64_t k) {
  const double* row = s.collider_state + k * kColliderColumns;
  return collider_valid(row, s.sdf_count) && collider_springs(row);
}

// The middle of a home, from which its points lie within 3 cells on each axis [m].
template <typename T>
GSF_HOST_DEVICE Vec3<double> home_middle(const SolverView<T>& s, const int32_t* block) {
  const double dx = double(s.dx);
  return {(4.0 * block[0] + 2.5) * dx, (4.0 * block[1] + 2.5) * dx, (4.0 * block[2] + 2.5) * dx};
}
// How near to it a collider must be to push a point of it now [m].
template <typename T>
GSF_HOST_DEVICE double home_reach(const SolverView<T>& s) {
  return (5.2 + kSpringReach) * double(s.dx);
}

// A point and its place [m].
template <typename T>
struct PushedPoint {
  Vec3<double> x;
  T velocity[3];
  double radius;  // [m]
  double kept;  // share of a push that is left while it parts: the spring loses as its matter does
  int64_t row;
};

// What collider k gives to a point in a step, added to out: impulse and how much it may rub [N s].
// `longest` = spring_step. False when nothing.
template <typename T>
GSF_HOST_DEVICE bool push_point(const SolverView<T>& s, int64_t k, const PushedPoint<T>& p,
                                double longest, T* out) {
  using std::cbrt;
  const double* row = s.collider_state + k * kColliderColumns;
  const double dx = double(s.dx), dt = s.clock->dt;
  Vec3<double> normal;
  double depth = p.radius - collider_signed_distance(row, s.sdf, p.x, normal);
  if (!(depth > 0.0)) return false;
  const double volume = row_volume(s, p.row), wave = row_wave(s, p.row);
  const double mass = volume / double(s.rows[p.row * kRowColumns + kInverseDensityColumn]);
  const Vec3<double> own = collider_velocity(row, p.x);
  double away = 0.0;
  for (int axis = 0; axis < 3; ++axis)
    away += normal[axis] * (double(p.velocity[axis]) - own[axis]);
  const double stopped = -away * spring_stop(depth, dx);
  depth = max(0.0, depth - spring_lag(wave, dx) * away);
  const double pushed =
      spring_speed(depth, wave, cbrt(volume), dx, dt, longest, 1.0 + row[kStiffer]);
  const double gained = max(away > 0.0 ? p.kept * pushed : pushed, stopped);
  for (int axis = 0; axis < 3; ++axis) out[axis] += T(mass * gained * normal[axis]);
  out[3] += T(row[kFriction] * mass * gained);
  return true;
}

// A point as points of other objects see it.
struct TouchMatter {
  double volume;     // in cells
  double stiffness;  // K [Pa]
};
template <typename T>
GSF_HOST_DEVICE TouchMatter touch_matter(const SolverView<T>& s, int64_t row, double longest) {
  using std::cbrt;
  const double dx = double(s.dx), volume = row_volume(s, row);
  const double density = 1.0 / double(s.rows[row * kRowColumns + kInverseDensityColumn]);
  return {volume / (dx * dx * dx),
          touch_stiffness(density, row_wave(s, row), cbrt(volume), dx, longest)};
}

// Sums over the points of other objects near one.
struct TouchFound {
  double share;      // of other matter
  double stiffness;  // times share
  double rate;       // of the share [1 / s]
};
// Adds the point q: d is the place of the one less that of q [cells], r2 its square below
// kTouchReach^2, velocities in cells per second.
GSF_HOST_DEVICE void add_found(const TouchMatter& q, const double* d, double r2,
                               const double* velocity, const double* velocity_q, TouchFound& sum) {
  const double found = q.volume * touch_kernel(r2);
  sum.share += found;
  sum.stiffness += found * q.stiffness;
  for (int axis = 0; axis < 3; ++axis)
    sum.rate += q.volume * touch_gradient(r2) * d[axis] * (velocity[axis] - velocity_q[axis]);
}
// V dE/df of a point that found this [Pa cells]: `touching` is the share at which it touches, `lag`
// the time of the damping, `kept` as of PushedPoint.
GSF_HOST_DEVICE double touch_energy(const TouchMatter& p, double touching, double lag, double kept,
                                    const TouchFound& sum) {
  const double over = sum.share - touching;
  if (!(over > 0.0)) return 0.0;
  return (sum.rate < 0.0 ? kept : 1.0) * p.volume * max(0.0, over + lag * sum.rate) *
         min(p.stiffness, sum.stiffness / sum.share);
}
// Force of a pair over d, from the energies and volumes of both.
GSF_HOST_DEVICE double touch_force(double energy, double volume, double energy_q, double volume_q,
                                   double r2) {
  return (energy * volume_q + energy_q * volume) * touch_gradient(r2);
}
// What a point gets in a step from the sum of those forces times d, [4]: impulse and its length
// [N s].
template <typename T>
GSF_HOST_DEVICE void touch_given(const double* sum, double dt, double dx, T* out) {
  using std::abs;
  using std::sqrt;
  const double scale = -dt * dx * dx;
  double length = 0.0;
  for (int axis = 0; axis < 3; ++axis) {
    out[axis] = T(scale * sum[axis]);
    length += sum[axis] * sum[axis];
  }
  out[3] = T(abs(scale) * sqrt(length));
}

// Whether collider k acts on nodes at x: one that pushes points does so far behind its surface.
template <typename T>
GSF_HOST_DEVICE bool holds_node(const SolverView<T>& s, int64_t k, const Vec3<T>& x) {
  const T* row = s.colliders + k * kColliderColumns;
  if (s.radius == nullptr || !collider_valid(row, s.sdf_count) || !collider_springs(row))
    return true;
  Vec3<T> normal;
  return collider_signed_distance(row, s.sdf, x, normal) <= T(-kSpringNode) * s.dx;
}

// The nearest to x of `count` colliders, of which the i-th is which(i), or -1 for none.
template <typename T, typename Which>
GSF_HOST_DEVICE int64_t nearest_collider(const SolverView<T>& s, int64_t count, const Which& which,
                                         const Vec3<T>& x) {
  if (count == 1) return which(0);
  int64_t found = -1;
  T least = T(INFINITY);
  for (int64_t i = 0; i < count; ++i) {
    const int64_t k = which(i);
    if (k < 0) continue;
    Vec3<T> normal;
    const T d = collider_signed_distance(s.colliders + k * kColliderColumns, s.sdf, x, normal);
    if (found < 0 || d < least) {
      least = d;
      found = k;
    }
  }
  return found;
}

// Friction between the objects whose points about a node push each other. Fields that move as one
// rub as one. push(f, c) = sums of touch_given of the f-th field.
template <typename T, typename Number, typename Mass, typename Push>
GSF_HOST_DEVICE void node_hold(const SolverView<T>& s, int fields, const bool* heavy,
                               const Number& number, const Mass& mass, const Push& push,
                               Vec3<T>* velocity) {
  struct Group {
    uint32_t fields;
    int first;
    double mass, push[4];
  } groups[kSiteFields];
  int count = 0;
  uint32_t done = 0;
  for (int a = 0; a < fields; ++a) {
    if (!heavy[a] || (done >> a & 1u) != 0) continue;
    Group group{node_group(s, fields, heavy, number, a), a, 0.0, {0.0, 0.0, 0.0, 0.0}};
    done |= group.fields;
    for (int f = 0; f < fields; ++f) {
      if ((group.fields >> f & 1u) == 0) continue;
      for (int c = 0; c < 4; ++c) group.push[c] += double(push(f, c));
      group.mass += mass(f);
    }
    groups[count++] = group;
  }
  for (int i = 0; i < count; ++i)
    for (int j = i + 1; j < count; ++j) {
      const Group &a = groups[i], &b = groups[j];
      if (!s.touches_by_points(number(a.first), number(b.first))) continue;
      Vec3<double> given, relative;
      for (int c = 0; c < 3; ++c) {
        given[c] = a.push[c] - b.push[c];
        relative[c] = double(velocity[a.first][c]) - double(velocity[b.first][c]);
      }
      const Vec3<double> along =
          touch_friction(given, relative, s.contact.friction * 0.5 * (a.push[3] + b.push[3]),
                         a.mass / (a.mass + b.mass) * b.mass);
      for (int f = 0; f < fields; ++f)
        for (int c = 0; c < 3; ++c) {
          if (a.fields >> f & 1u) velocity[f][c] -= T(along[c] / a.mass);
          if (b.fields >> f & 1u) velocity[f][c] += T(along[c] / b.mass);
        }
    }
}

// Friction of the points about a node at x that colliders pushed, and what those gave: on the
// account of the nearest of them. Fields that move as one rub as one. push(f, c) = sums of
// push_point of the f-th field, nearest() the collider or -1, account(k) its sums of the step.
template <typename T, typename Number, typename Mass, typename Push, typename Nearest,
          typename Account>
GSF_HOST_DEVICE void node_rub(const SolverView<T>& s, int fields, const bool* heavy,
                              const Number& number, const Mass& mass, const Push& push,
                              const Vec3<T>& x, const Nearest& nearest, const Account& account,
                              Vec3<T>* velocity) {
  bool pushed = false;
  for (int f = 0; f < fields; ++f)
    pushed = pushed || push(f, 0) != T(0) || push(f, 1) != T(0) || push(f, 2) != T(0);
  if (!pushed) return;
  int64_t k = -1;
  uint32_t done = 0;
  for (int a = 0; a < fields; ++a) {
    if (!heavy[a] || (done >> a & 1u) != 0) continue;
    const uint32_t group = node_group(s, fields, heavy, number, a);
    done |= group;
    double total = 0.0;
    T sum[4] = {T(0), T(0), T(0), T(0)};
    for (int f = 0; f < fields; ++f) {
      if ((group >> f & 1u) == 0) continue;
      for (int c = 0; c < 4; ++c) sum[c] += push(f, c);
      total += mass(f);
    }
    const Vec3<T> j{sum[0], sum[1], sum[2]};
    if (!(dot(j, j) > T(0))) continue;
    if (k < 0) k = nearest();
    if (k < 0) return;
    const T* row = s.colliders + k * kColliderColumns;
    const Vec3<T> v = velocity[a];
    const Vec3<T> after = spring_friction(v, collider_velocity(row, x), j, sum[3], T(total));
    double given[3], arm[3];
    for (int i = 0; i < 3; ++i) {
      given[i] = double(j[i]) + total * (double(after[i]) - double(v[i]));
      arm[i] = double(x[i]) - double(row[kPoint + i]);
    }
    double* sums = account(k);
    for (int i = 0; i < 3; ++i) {
      sums[i] += given[i];
      sums[3 + i] += arm[(i + 1) % 3] * given[(i + 2) % 3] - arm[(i + 2) % 3] * given[(i + 1) % 3];
    }
    sums[6] += total;
    for (int f = 0; f < fields; ++f)
      if (group >> f & 1u) velocity[f] = velocity[f] + (after - v);
  }
}

}  // namespace gsf
