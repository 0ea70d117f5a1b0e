// Minimum-volume enclosing ellipsoid of one point set, by the interior-point method of
// barrier.h (docs/theory/mvee.md).
#pragma once

#include "core/mvee/barrier.h"
#include "core/mvee/ellipsoid.h"

namespace gsf {
namespace detail {

// Mean and principal axes of the points, and how many of the axes carry any extent.
struct Principal {
  Dvec mean;
  Dmat axes;       // columns
  Dvec deviation;  // standard deviation along each
  int rank;
};

template <typename T>
GSF_HOST_DEVICE Dvec load_point(const T* p) {
  return {double(p[0]), double(p[1]), double(p[2])};
}

// In double whatever the type of the points, so that sets much thinner than wide keep their shape.
template <typename T, class Team>
GSF_HOST_DEVICE Principal principal(const Team& team, const T* points, int n) {
  using std::abs;
  using std::sqrt;
  Principal r;
  const Dvec first = load_point(points);
  double s[3] = {};
  for (int j = team.rank(); j < n; j += team.size()) {
    const Dvec x = load_point(points + 3 * j) - first;
    for (int c = 0; c < 3; ++c) s[c] += x[c];
  }
  for (int c = 0; c < 3; ++c) r.mean[c] = first[c] + team.sum(s[c]) / n;
  double v[6] = {};
  for (int j = team.rank(); j < n; j += team.size()) {
    const Dvec y = load_point(points + 3 * j) - r.mean;
    const double entry[6] = {y.x * y.x, y.y * y.y, y.z * y.z, y.x * y.y, y.x * y.z, y.y * y.z};
    for (int c = 0; c < 6; ++c) v[c] += entry[c];
  }
  for (int c = 0; c < 6; ++c) v[c] = team.sum(v[c]) / n;
  const Svd3<double> eigen = svd3(to_mat3(load_sym3(v)));
  r.axes = eigen.u;
  for (int c = 0; c < 3; ++c) r.deviation[c] = sqrt(abs(eigen.sigma[c]));
  // Thinner than this is rounding: of the coordinates, or of the covariance.
  const double eps = sizeof(T) == 4 ? 1e-6 : 4e-15;
  const double size = max(max(abs(r.mean.x), abs(r.mean.y)), abs(r.mean.z)) + r.deviation.x;
  const double least = max(1e-7 * r.deviation.x, eps * size);
  r.rank = (r.deviation.x > least) + (r.deviation.y > least) + (r.deviation.z > least);
  return r;
}

}  // namespace detail

// Smallest semi-axis of a flat or single-point fit, relative to the largest one: keeps the shape
// matrix positive definite.
inline constexpr double kMveeFlatAxis = 1e-4;

// Fits `n` >= 1 points ([n, 3], finite) so that the volume exceeds the smallest by at most the
// fraction `tolerance`, as far as T resolves it, in at most `max_iterations` steps; contains every
// point in any case. `fit` is scratch of n.
template <typename T, class Team>
GSF_HOST_DEVICE Ellipsoid<T> mvee_fit(const Team& team, const T* points, int n, FitPoint<T>* fit,
                                      double tolerance, int max_iterations) {
  using std::abs;
  using std::sqrt;
  const detail::Principal frame = detail::principal(team, points, n);
  const int d = frame.rank;
  // Coordinates along the axes in standard deviations; zero along flat axes.
  for (int j = team.rank(); j < n; j += team.size()) {
    const Vec3<double> x = detail::load_point(points + 3 * j) - frame.mean;
    FitPoint<T>& p = fit[j];
    p.y = {T(0), T(0), T(0)};
    for (int c = 0; c < d; ++c)
      p.y[c] = T(dot(detail::column(frame.axes, c), x) / frame.deviation[c]);
    p.u = T(1) / T(n);
    p.s = T(1);
  }
  team.sync();

  // The volume of the fit scaled to its furthest point exceeds the smallest by at most
  // reach^(d / 2) - 1, because the multipliers bound the smallest from below.
  LiftedFactor<T> factor = lifted_factor(team, fit, n, d), best = factor;
  T best_reach = T(1e30), highest_of_best = T(0), gap = T(0);
  const T rounding = sizeof(T) == 4 ? T(2e-6) : T(1e-13);
  const T enough = T(1) + max(T(2.0 * tolerance / max(d, 1) * 0.9), rounding);
  int stalled = 0;
  for (int step = 0; d > 0; ++step) {
    T highest = T(0), sum = T(0);
    for (int j = team.rank(); j < n; j += team.size()) {
      highest = max(highest, factor.distance(fit[j].y));
      sum += fit[j].u * fit[j].s;
    }
    highest = team.largest(highest);
    gap = team.sum(sum);
    const T reach = highest * factor.total / T(d);
    stalled = reach < best_reach ? 0 : stalled + 1;
    if (reach < best_reach) {
      best_reach = reach;
      best = factor;
      highest_of_best = highest;
    }
    // Not before 1 % is reached: the first steps may go up. NaN ends it as well.
    if (step >= max_iterations || best_reach <= enough || !(reach < T(1e30)) ||
        (stalled > 4 && best_reach < T(1.01)) || stalled > 20)
      break;
    if (step == 0) gap = barrier_start(team, fit, n, factor, highest, T(0.1));
    barrier_step(team, fit, n, factor, T(0.1) * gap / T(n));
    factor = lifted_factor(team, fit, n, d);
  }

  // Flat axes: the little extent the points have, doubled thrice so that the final scaling stays
  // within 2 percent, but at least a sliver of the longest axis.
  const Mat3<T> local = best.root();
  Mat3<double> root{};
  Vec3<double> center = frame.mean;
  double longest = 0.0, flat = 0.0;
  for (int a = 0; a < d; ++a) {
    const Vec3<double> axis = frame.deviation[a] * detail::column(frame.axes, a);
    center = center + double(best.mean[a]) * axis;
    double length = 0.0;
    for (int b = 0; b < d; ++b) {
      length += double(local(a, b)) * double(local(a, b));
      for (int i = 0; i < 3; ++i) root(i, b) += double(local(a, b)) * axis[i];
    }
    longest = max(longest, frame.deviation[a] * sqrt(length * double(highest_of_best)));
  }
  // As far out as the furthest point, and a little for rounding.
  double grow = max(double(highest_of_best), d > 0 ? d / double(best.total) : 0.0) *
                (sizeof(T) == 4 ? 1.0 + 4e-6 : 1.0 + 1e-13);
  const double size = max(max(abs(center.x), abs(center.y)), abs(center.z));
  const double eps = sizeof(T) == 4 ? 1e-6 : 1e-14;
  const double sliver = max(max(kMveeFlatAxis * longest, eps * size), 1e-18);
  double thickness[3] = {};
  for (int a = d; a < 3; ++a) {
    double extent = 0.0;
    for (int j = team.rank(); j < n; j += team.size())
      extent =
          max(extent,
              abs(dot(detail::column(frame.axes, a), detail::load_point(points + 3 * j) - center)));
    extent = team.largest(extent);
    thickness[a] = max(8.0 * extent, sliver);
    flat += extent * extent / (thickness[a] * thickness[a]);
  }
  const double stretch = d > 0 ? sqrt(1.0 + flat) : 1.0;
  grow = sqrt(grow) * stretch;
  for (int a = 0; a < d; ++a)
    for (int i = 0; i < 3; ++i) root(i, a) *= grow;
  for (int a = d; a < 3; ++a)
    detail::set_column(root, a, (thickness[a] * stretch) * detail::column(frame.axes, a));
  return stored_ellipsoid<T>(center, root, 1.0);
}

}  // namespace gsf
