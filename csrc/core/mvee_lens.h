// Smallest ellipsoid around the overlap of two ellipsoids (docs/mvee.md).
#pragma once

#include "core/mvee_ascent.h"

namespace gsf {

// Points of the fit come in eight groups (a lane each on the GPU): points g, g + 8, ... belong to
// group g. First the fixed ones of the rim, then those of the caps, then the slots for furthest
// points.
inline constexpr int kLensGroups = 8;
inline constexpr int kLensRim = 3, kLensCaps = 3, kLensSlots = 4;  // per group
inline constexpr int kLensFixed = kLensGroups * (kLensRim + kLensCaps);
inline constexpr int kLensPoints = kLensFixed + kLensGroups * kLensSlots;
inline constexpr int kLensSteps = 40;  // most steps of the fit

// Fits the overlap; the result is { |k (y, 1)|^2 total <= 1 + 3 reach } in the setup's frame:
// center and inverse factor. `points` is scratch of kLensPoints.
template <typename T>
struct LensFit {
  Vec3<T> center;
  Mat3<T> root;  // { center + root z, |z| <= 1 }
  int steps;
  T reach;  // how far the points reach out of the ellipsoid of their weights, squared
};

template <typename T, class Team>
GSF_HOST_DEVICE LensFit<T> lens_fit(const Team& team, const detail::Overlap<T>& overlap,
                                    FitPoint<T>* points) {
  using detail::Objective;
  using std::abs;
  using std::sqrt;
  for (int i = team.rank(); i < kLensPoints; i += team.size()) {
    FitPoint<T>& p = points[i];
    const int home = i < kLensFixed ? i : i - kLensFixed;
    p.y = home < kLensRim * kLensGroups
              ? overlap.rim(detail::fibonacci_direction<T>(home, kLensRim * kLensGroups))
              : overlap.on_surface(detail::fibonacci_direction<T>(home - kLensRim * kLensGroups,
                                                                  kLensCaps * kLensGroups));
    p.u = T(1.0 / kLensPoints);
    p.s = T(1);
  }
  team.sync();
  LiftedFactor<T> factor, best{};
  LensFit<T> out;
  T best_excess = T(1e30), highest = T(0), complementarity = T(0);
  int step = 0;
  const auto on_rim = [&](const Vec3<T>& y) {
    return abs(detail::gauge(overlap.a, y) - detail::gauge(overlap.b, y)) < T(1e-3);
  };
  T gap = T(0.05);
  for (; step < kLensSteps; ++step) {
    factor = lifted_factor(team, points, kLensPoints, 3);
    highest = T(0);
    const Objective<T> objective(factor);
    for (int i = team.rank(); i < kLensPoints; i += team.size())
      highest = max(highest, factor.distance(points[i].y));
    highest = team.largest(highest);
    const bool climb = step > 0 && (highest * factor.total < T(3) + gap ||
                                    complementarity < T(2e-4) || step == kLensSteps - 1);
    const T worth = T(3) * (T(1) + T(1e-4)) / factor.total;
    T sum = T(0);
    for (int g = team.rank(); climb && g < kLensGroups; g += team.size()) {
      T furthest = T(0);
      Vec3<T> found{T(0), T(0), T(0)};
      T best_cap = T(0);
      int start = 0;
      for (int i = g + kLensGroups * kLensRim; i < kLensFixed; i += kLensGroups) {
        const T m = factor.distance(points[i].y);
        if (m > best_cap) {
          best_cap = m;
          start = i;
        }
      }
      for (int i = g; i < kLensPoints; i += kLensGroups) {
        const bool rim_home = i < kLensGroups * kLensRim;
        if (!rim_home && i < kLensFixed && i != start) continue;
        Vec3<T> y = points[i].y;
        const bool rim = rim_home || (i >= kLensFixed && on_rim(y));
        const T m = detail::climb(overlap, objective, factor, rim, 4, y);
        highest = max(highest, m);
        if (m > furthest) {
          furthest = m;
          found = y;
        }
      }
      if (furthest > worth) {
        int slot = kLensFixed + g;
        T least = T(1e30);
        for (int i = kLensFixed + g; i < kLensPoints; i += kLensGroups) {
          // A slot close by is refined; otherwise the least important one is taken.
          const T rank = norm(points[i].y - found) < T(0.01) ? T(-1) : points[i].u;
          if (rank < least) {
            least = rank;
            slot = i;
          }
        }
        points[slot].y = found;
        points[slot].u = max(points[slot].u, T(0.005));
      }
    }
    for (int i = team.rank(); i < kLensPoints; i += team.size()) {
      FitPoint<T>& p = points[i];
      highest = max(highest, factor.distance(p.y));
      sum += p.u * p.s;
    }
    team.sync();
    highest = team.largest(highest);
    complementarity = team.sum(sum);
    const T excess = highest * factor.total - T(3);
    if (climb && !(excess >= best_excess)) {
      best_excess = excess;
      best = factor;
    }
    if (climb && excess < T(3) * T(5e-4)) break;
#ifdef TRACE
    if (TRACE)
      printf("  %d: highest %.6f total %.5f gap %.2e climb %d reach %.6f\n", step, (double)highest,
             (double)factor.total, (double)complementarity, climb,
             double(highest * factor.total) / 3);
#endif
    if (climb) gap = max(T(0.1) * excess, T(7.5e-4));
    if (climb || step == 0) {
      // Back to a well-centred start: no multiplier near zero, every slack positive and exact.
      if (step > 0) {
        for (int i = team.rank(); i < kLensPoints; i += team.size())
          points[i].u = max(points[i].u, T(0.002));
        team.sync();
        factor = lifted_factor(team, points, kLensPoints, 3);
        highest = T(0);
        for (int i = team.rank(); i < kLensPoints; i += team.size())
          highest = max(highest, factor.distance(points[i].y));
        highest = team.largest(highest);
      }
      complementarity =
          barrier_start(team, points, kLensPoints, factor, highest, step == 0 ? T(0.1) : T(0.01));
    }
    const T target = max(T(0.1) * complementarity, T(1e-4)) / T(kLensPoints);
    barrier_step(team, points, kLensPoints, factor, target);
    sum = T(0);
    for (int i = team.rank(); i < kLensPoints; i += team.size()) sum += points[i].u * points[i].s;
    complementarity = team.sum(sum);
  }
  // The lower Cholesky factor of the shape, as far out as the furthest point.
  const T margin = sizeof(T) == 4 ? T(1) + T(3e-6) : T(1) + T(1e-7);
  const T reach = T(1) + max(best_excess * T(1.0 / 3.0), T(0));
  out.center = best.mean;
  out.root = (margin * sqrt(T(3) * reach / best.total)) * best.root();
  out.steps = step;
  out.reach = reach;
  return out;
}

template <typename T>
struct LensResult {
  Vec3<T> mean;
  Sym3<T> covariance;
  bool overlap;
};

namespace detail {

template <typename T>
GSF_HOST_DEVICE Overlap<T> overlap_of(const LensSetup& s) {
  const auto cast = [](const Quadric<double>& q) {
    return Quadric<T>{{T(q.w.xx), T(q.w.yy), T(q.w.zz), T(q.w.xy), T(q.w.xz), T(q.w.yz)},
                      {T(q.b.x), T(q.b.y), T(q.b.z)}};
  };
  return {cast(s.a), cast(s.b)};
}

}  // namespace detail

template <typename T>
GSF_HOST_DEVICE Vec3<double> to_double(const Vec3<T>& v) {
  return {double(v.x), double(v.y), double(v.z)};
}
template <typename T>
GSF_HOST_DEVICE Sym3<double> to_double(const Sym3<T>& s) {
  return {double(s.xx), double(s.yy), double(s.zz), double(s.xy), double(s.xz), double(s.yz)};
}

template <typename T>
GSF_HOST_DEVICE LensResult<T> lens_nothing(const LensSetup& s) {
  return {
      {T(s.center.x), T(s.center.y), T(s.center.z)}, {T(0), T(0), T(0), T(0), T(0), T(0)}, false};
}

// The ellipsoid { center + root z, |z| <= 1 } as a Gaussian of type T, widened by what rounding may
// take away: the stored ellipsoid contains the exact one.
template <typename T>
GSF_HOST_DEVICE LensResult<T> lens_gaussian(const Vec3<double>& center, const Mat3<double>& root,
                                            double radius) {
  const Ellipsoid<T> e = stored_ellipsoid<T>(center, root, 1.0 / (radius * radius));
  return {e.center, e.shape, true};
}

// Semi-axes of a fit no shorter than `flat` times the longest, where the best ellipsoid of the
// pencil is a ball.
GSF_HOST_DEVICE Mat3<double> lens_thickened(const Mat3<double>& root, const Vec3<double>& half,
                                            double flat) {
  Mat3<double> scaled;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) scaled(i, j) = half[i] * root(i, j);
  const Svd3<double> e = svd3(scaled);
  Mat3<double> out;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) out(i, j) = e.u(i, j) * max(e.sigma[j], flat * e.sigma.x) / half[i];
  return out;
}

// The answer from a fit in the setup's frame.
template <typename T>
GSF_HOST_DEVICE LensResult<T> lens_result(const Vec3<double>& origin, const Mat3<double>& frame,
                                          const Vec3<double>& half, const LensFit<T>& fit,
                                          double radius, double flat) {
  Mat3<double> root;
  for (int i = 0; i < 9; ++i) root.m[i] = double(fit.root.m[i]);
  if (flat > 0.0) root = lens_thickened(root, half, flat);
  const Vec3<double> center{double(fit.center.x), double(fit.center.y), double(fit.center.z)};
  return lens_gaussian<T>(origin + matvec(frame, center), matmul(frame, root), radius);
}

// Gaussians (mean, covariance) stand for their `radius`-sigma ellipsoids; the result is a Gaussian
// in the same sense. `points` is scratch of kLensPoints. Without overlap the covariance is zero and
// the mean the midpoint.
template <typename T>
GSF_HOST_DEVICE LensResult<T> mvee_lens(const Vec3<T>& mean_a, const Sym3<T>& cov_a,
                                        const Vec3<T>& mean_b, const Sym3<T>& cov_b, double radius,
                                        double flat, FitPoint<T>* points) {
  const LensSetup setup = lens_setup(to_double(mean_a), to_double(cov_a), to_double(mean_b),
                                     to_double(cov_b), radius, flat);
  if (setup.kind == LensKind::kNone) return lens_nothing<T>(setup);
  if (setup.kind == LensKind::kKnown) return lens_gaussian<T>(setup.center, setup.frame, radius);
  const LensFit<T> fit = lens_fit(SerialTeam{}, detail::overlap_of<T>(setup), points);
  return lens_result(setup.center, setup.frame, setup.half, fit, radius, flat);
}

}  // namespace gsf
