// Points of the resident solver that rigid colliders push: core/collider/spring.h.
#pragma once

#include "core/collider/spring.h"
#include "core/solver/node.h"
#include "cpu/solver/packet.h"

namespace gsf::cpu {

// P-wave speed of a row at rest [m/s].
template <typename T>
double row_wave(const SolverView<T>& s, int64_t row) {
  const T* r = s.rows + row * kRowColumns;
  return double(r[kPaceColumn]) * double(r[kInverseDensityColumn]) /
         (kSlowUnloading * double(s.dx));
}

// Step [s] that springs of points must bear: the longest at rest. Not the present one: a spring
// that is stiffer in a short step gives back more than it took.
template <typename T>
double spring_step(const SolverView<T>& s) {
  const SolverClock& c = *s.clock;
  double wave = 0.0;
  for (int64_t row = 0; row < s.row_count; ++row) wave = std::max(wave, row_wave(s, row));
  return c.dt_fixed > 0.0 ? c.dt_fixed : c.cfl * double(s.dx) / std::max(wave, 1e-30);
}

template <typename T>
class SurfacePlan {
 public:
  explicit SurfacePlan(const SolverView<T>& s) : s_(s) {}

  // Which colliders push points and which homes they can reach before the next build.
  void make() {
    const SolverClock& c = *s_.clock;
    springs_.clear();
    for (int64_t k = 0; s_.radius != nullptr && k < s_.collider_count; ++k) {
      const double* row = s_.collider_state + k * kColliderColumns;
      if (collider_valid(row, s_.sdf_count) && collider_springs(row))
        springs_.push_back(static_cast<int32_t>(k));
    }
    step_ = spring_step(s_);
    near_.assign(springs_.empty() ? 0 : c.homes, 0);
    push_.assign(springs_.empty() ? 0 : c.slots * kBlockNodes * 4, T(0));
    for (int64_t h = 0; h < static_cast<int64_t>(near_.size()); ++h)
      near_[h] = within(h, 1.0) ? 1 : 0;  // a collider moves one cell at most until then
  }

  bool any() const { return !springs_.empty(); }
  const std::vector<int32_t>& springs() const { return springs_; }
  bool near(int64_t h) const { return any() && near_[h] != 0 && within(h, 0.0); }

  // What the points `entry[0..count)` of home h get, [count, 4]: impulse and how much they may rub
  // [N s].
  // False when none gets any.
  bool pushes(int64_t h, const int32_t* entry, int64_t count, std::vector<T>& out) const {
    const int32_t* b = s_.homes().coord + 4 * h;
    const double dx = double(s_.dx), dt = s_.clock->dt;
    bool any = false, close = false;
    uint32_t cell = ~0u;
    out.assign(4 * count, T(0));
    for (int64_t i = 0; i < count; ++i) {
      const int64_t p = entry[i];
      const uint32_t meta = s_.meta[p];
      if ((meta & 511u) != cell) {  // points come cell by cell
        cell = meta & 511u;
        Vec3<double> middle;
        for (int axis = 0; axis < 3; ++axis)
          middle[axis] = (4.0 * b[axis] + meta_cell(meta, axis)) * dx;
        close = reaches(middle, (0.87 + kSpringReach) * dx);
      }
      if (!close) continue;
      Vec3<double> x;
      for (int axis = 0; axis < 3; ++axis)
        x[axis] =
            (4.0 * b[axis] - 0.5 + meta_cell(meta, axis) + double(s_.offset[3 * p + axis])) * dx;
      const double radius = double(s_.radius[s_.id[p]]);
      for (const int32_t k : springs_) {
        const double* row = s_.collider_state + int64_t(k) * kColliderColumns;
        Vec3<double> normal;
        double depth = radius - collider_signed_distance(row, s_.sdf, x, normal);
        if (!(depth > 0.0)) continue;
        const T* r = s_.rows + int64_t(s_.row_of(meta)) * kRowColumns;
        const double mass = double(r[kMassColumn]), thin = double(r[kInverseDensityColumn]);
        const double wave = row_wave(s_, s_.row_of(meta));
        const Vec3<double> own = collider_velocity(row, x);
        double away = 0.0;
        for (int axis = 0; axis < 3; ++axis)
          away += normal[axis] * (double(s_.velocity[3 * p + axis]) - own[axis]);
        depth = std::max(0.0, depth - spring_lag(wave, dx) * away);
        const double gained = spring_speed(depth, wave, std::cbrt(mass * thin), dx, dt, step_);
        for (int axis = 0; axis < 3; ++axis) out[4 * i + axis] += T(mass * gained * normal[axis]);
        out[4 * i + 3] += T(row[kFriction] * mass * gained);
        any = true;
      }
    }
    return any;
  }

  // Sums of these over the points about each node: [slots, 64, 4].
  T* sums() { return push_.data(); }
  const T* sums() const { return push_.data(); }

  // The collider nearest to x.
  int32_t nearest(const Vec3<T>& x) const {
    int32_t found = springs_[0];
    T least = T(INFINITY);
    for (const int32_t k : springs_) {
      Vec3<T> normal;
      const T d =
          collider_signed_distance(s_.colliders + int64_t(k) * kColliderColumns, s_.sdf, x, normal);
      if (d < least) {
        least = d;
        found = k;
      }
    }
    return found;
  }

 private:
  // Whether a point of home h may be pushed: they lie within 3 cells of its middle on each axis.
  bool within(int64_t h, double more) const {
    const int32_t* b = s_.homes().coord + 4 * h;
    const double dx = double(s_.dx);
    const Vec3<double> middle{(4.0 * b[0] + 2.5) * dx, (4.0 * b[1] + 2.5) * dx,
                              (4.0 * b[2] + 2.5) * dx};
    return reaches(middle, (5.2 + kSpringReach + more) * dx);
  }
  // Whether a collider that pushes points is nearer to x than `far`.
  bool reaches(const Vec3<double>& x, double far) const {
    for (const int32_t k : springs_) {
      const double* row = s_.collider_state + int64_t(k) * kColliderColumns;
      if (collider_clearance(row, s_.sdf, x) <= far) return true;
    }
    return false;
  }

  const SolverView<T>& s_;
  double step_ = 0.0;             // [s] for which springs are stable
  std::vector<int32_t> springs_;  // colliders
  std::vector<uint8_t> near_;     // [homes]
  std::vector<T> push_;           // [slots, 64, 4]
};

}  // namespace gsf::cpu
