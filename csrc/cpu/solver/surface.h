// Points of the resident solver that rigid colliders push: core/collider/spring.h.
#pragma once

#include "core/solver/points.h"
#include "cpu/solver/packet.h"

namespace gsf::cpu {

// The step that springs of points must bear [s].
template <typename T>
double spring_step(const SolverView<T>& s) {
  double wave = 0.0;
  for (int64_t row = 0; row < s.row_count; ++row) wave = std::max(wave, row_wave(s, row));
  return spring_step(*s.clock, wave, double(s.dx));
}

template <typename T>
class SurfacePlan {
 public:
  explicit SurfacePlan(const SolverView<T>& s) : s_(s) {}

  // Which colliders push points and which homes they can reach before the next build.
  void make() {
    const SolverClock& c = *s_.clock;
    springs_.clear();
    for (int64_t k = 0; s_.radius != nullptr && k < s_.collider_count; ++k)
      if (pushes_points(s_, k)) springs_.push_back(static_cast<int32_t>(k));
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
    const double dx = double(s_.dx);
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
      PushedPoint<T> point;
      for (int axis = 0; axis < 3; ++axis)
        point.x[axis] =
            (4.0 * b[axis] - 0.5 + meta_cell(meta, axis) + double(s_.offset[3 * p + axis])) * dx;
      load_speed(s_, p, point.velocity);
      point.radius = double(s_.radius[2 * int64_t(s_.id[p])]);
      point.kept = double(s_.radius[2 * int64_t(s_.id[p]) + 1]);
      point.row = s_.row_of(meta);
      for (const int32_t k : springs_) any = push_point(s_, k, point, step_, &out[4 * i]) || any;
    }
    return any;
  }

  // Sums of these over the points about each node: [slots, 64, 4].
  T* sums() { return push_.data(); }
  const T* sums() const { return push_.data(); }

  // The collider nearest to x.
  int64_t nearest(const Vec3<T>& x) const {
    const int64_t count = static_cast<int64_t>(springs_.size());
    return nearest_collider(s_, count, [&](int64_t i) { return springs_[i]; }, x);
  }

 private:
  // Whether a point of home h may be pushed once a collider has come `more` cells nearer.
  bool within(int64_t h, double more) const {
    const Vec3<double> middle = home_middle(s_, s_.homes().coord + 4 * h);
    return reaches(middle, home_reach(s_) + more * double(s_.dx));
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
