// Smallest ellipsoid around the overlap of two ellipsoids (docs/theory/mvee.md).
#pragma once

#include "core/mvee/ascent.h"

namespace gsf {

// Points of the overlap that stay where they are: the starts of every search for its furthest
// points.
inline constexpr int kLensRim = 24, kLensCaps = 24;
inline constexpr int kLensPoints = 24;  // points of the fit; nine determine an ellipsoid
inline constexpr int kLensRounds = 16;  // searches at most
inline constexpr int kLensSteps = 6;    // steps of the fit between two searches, at most

// Fit in the setup's frame: { center + root z, |z| <= 1 }.
template <typename T>
struct LensFit {
  Vec3<T> center;
  Mat3<T> root;
  int steps;
  T reach;  // how far the overlap reaches out of the ellipsoid of the multipliers, squared
};

namespace detail {

template <typename T>
GSF_HOST_DEVICE T largest_distance(const FitPoint<T>* points, const LiftedFactor<T>& factor) {
  T highest = T(0);
  for (int i = 0; i < kLensPoints; ++i) highest = max(highest, factor.distance(points[i].y));
  return highest;
}

// Puts a point into the slot close by, or else into the least important one.
template <typename T>
GSF_HOST_DEVICE void add_point(FitPoint<T>* points, const LiftedFactor<T>& factor, T m,
                               const Vec3<T>& y) {
  int slot = 0;
  T least = T(1e30);
  bool known = false;
  for (int j = 0; j < kLensPoints; ++j) {
    const Vec3<T> off = points[j].y - y;
    const bool near = dot(off, off) < T(9e-4);
    const T rank = near ? T(-1) : points[j].u;
    known = known || (near && !(m > factor.distance(points[j].y)));
    if (rank < least) {
      least = rank;
      slot = j;
    }
  }
  if (known) return;
  points[slot].y = y;
  points[slot].u = max(points[slot].u, T(0.02));
}

// Climbs from the furthest home of each group of the rim and of the caps, and from the poles, and
// adds what reaches out to the points; `many` makes the groups small. Returns the largest squared
// distance met. Not inlined on the device: the kernel waits for its instructions otherwise.
template <typename T>
GSF_HOST_DEVICE_COLD T search(const Overlap<T>& overlap, const LiftedFactor<T>& factor,
                              const Vec3<T>* homes, Vec3<T>* poles, bool many,
                              FitPoint<T>* points) {
  const Objective<T> objective(factor);
  const T worth = T(3) * (T(1) + T(2e-4)) / factor.total;
  T highest = T(0);
  const auto furthest = [&](int from, int to, int groups) {
    Vec3<T> y = homes[from];
    T most = factor.distance(y);
    for (int i = from + groups; i < to; i += groups) {
      const Vec3<T> z = homes[i];
      const T m = factor.distance(z);
      if (m > most) {
        most = m;
        y = z;
      }
    }
    return y;
  };
  const int rims = many ? kLensRim : 8, caps = many ? kLensCaps : 2;
  for (int g = 0; g < rims; ++g) {
    Vec3<T> y = furthest(g, kLensRim, rims);
    const T m = climb(overlap, objective, factor, true, 3, y);
    highest = max(highest, m);
    if (m > worth) add_point(points, factor, m, y);
  }
  for (int g = 0; g < caps + 2; ++g) {
    Vec3<T> y = g < caps ? furthest(kLensRim + g, kLensRim + kLensCaps, caps) : poles[g - caps];
    const T m = climb(overlap, objective, factor, false, many ? 4 : 3, y);
    highest = max(highest, m);
    if (g >= caps) poles[g - caps] = y;
    if (m > worth) add_point(points, factor, m, y);
  }
  return highest;
}

}  // namespace detail

// Smallest ellipsoid around the overlap: fits to a few of its points, in turn with searches for its
// furthest points, which replace the least important ones. `points` is scratch of kLensPoints.
template <typename T>
GSF_HOST_DEVICE LensFit<T> lens_fit(const detail::Overlap<T>& overlap, FitPoint<T>* points) {
  using std::sqrt;
  const SerialTeam team;
  constexpr int kHomes = kLensRim + kLensCaps;
  Vec3<T> homes[kHomes];
  for (int i = 0; i < kLensRim; ++i)
    homes[i] = overlap.rim(detail::fibonacci_direction<T>(i, kLensRim));
  for (int i = 0; i < kLensCaps; ++i)
    homes[kLensRim + i] = overlap.on_surface(detail::fibonacci_direction<T>(i, kLensCaps));
  for (int i = 0; i < kLensPoints; ++i) {
    // Two thirds from the rim, the rest from the caps, spread evenly.
    const int rim = (2 * kLensPoints) / 3;
    points[i].y = i < rim ? homes[(i * kLensRim) / rim]
                          : homes[kLensRim + ((i - rim) * kLensCaps) / (kLensPoints - rim)];
    points[i].u = T(1.0 / kLensPoints);
  }
  // The middles of the two caps, which follow the furthest points there.
  Vec3<T> poles[2] = {overlap.on_surface({T(1), T(0), T(0)}),
                      overlap.on_surface({T(-1), T(0), T(0)})};
  LiftedFactor<T> factor = lifted_factor(team, points, kLensPoints, 3), best{};
  T best_excess = T(1e30), gap = T(0.1), room = T(0.1);
  int steps = 0, round = 0;
  bool accepted = false;
  const auto keep_best = [&](T excess) {
    accepted = excess <= T(3) * T(6e-4);
    if (!(excess >= best_excess)) {
      best_excess = excess;
      best = factor;
    }
  };
  const auto restart = [&](T excess) {
    gap = max(T(0.1) * excess, T(7.5e-4));
    room = T(0.01);
    // Back to a well-centred start: no multiplier near zero, every slack positive and exact.
    for (int i = 0; i < kLensPoints; ++i) points[i].u = max(points[i].u, T(0.01));
    factor = lifted_factor(team, points, kLensPoints, 3);
  };
  // Rounds of the few starts until they find nothing, then once from many: two loops, so that the
  // threads of a warp search from many at the same time.
  while (!accepted && round < kLensRounds) {
    T highest = T(0);
    for (; round < kLensRounds; ++round) {
      highest = detail::largest_distance(points, factor);
      T complementarity = barrier_start(team, points, kLensPoints, factor, highest, room);
      for (int step = 0; step < kLensSteps; ++step, ++steps) {
        const T target = max(T(0.1) * complementarity, T(1e-4)) / T(kLensPoints);
        barrier_step(team, points, kLensPoints, factor, target);
        factor = lifted_factor(team, points, kLensPoints, 3);
        highest = T(0);
        complementarity = T(0);
        for (int i = 0; i < kLensPoints; ++i) {
          highest = max(highest, factor.distance(points[i].y));
          complementarity += points[i].u * points[i].s;
        }
        if (highest * factor.total < T(3) + gap || complementarity < T(2e-4)) break;
      }
      const T few = detail::search(overlap, factor, homes, poles, false, points);
      highest = max(highest, few);
      const T excess = highest * factor.total - T(3);
      keep_best(excess);
      if (accepted || round + 1 == kLensRounds) break;
      restart(excess);
    }
    const T many = detail::search(overlap, factor, homes, poles, true, points);
    highest = max(highest, many);
    const T excess = highest * factor.total - T(3);
    if (accepted) best_excess = T(1e30);  // it was not the whole truth
    keep_best(excess);
    ++round;
    if (!accepted) restart(excess);
  }
  const T margin = sizeof(T) == 4 ? T(1) + T(3e-6) : T(1) + T(1e-7);
  const T reach = T(1) + max(best_excess * T(1.0 / 3.0), T(0));
  LensFit<T> out;
  out.center = best.mean;
  out.root = (margin * sqrt(T(3) * reach / best.total)) * best.root();
  out.steps = steps;
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

// What may be wrong with one Gaussian; those of the second follow those of the first in `faults`.
enum LensFault : int {
  kMeanNotFinite,
  kCovarianceNotFinite,
  kNotPositive,
  kLensFaults,
  kSound = -1
};

// Positive semi-definite to rounding, relative to the trace so that the size of the scene does not
// matter; a zero axis is flat.
template <typename T>
GSF_HOST_DEVICE int lens_fault(const Vec3<T>& mean, const Sym3<T>& cov) {
  if (!finite(mean.x) || !finite(mean.y) || !finite(mean.z)) return kMeanNotFinite;
  if (!finite(cov)) return kCovarianceNotFinite;
  const Sym3<double> c = to_double(cov);
  const double sum = trace(c);
  const double minor =
      c.xx * c.yy - c.xy * c.xy + c.xx * c.zz - c.xz * c.xz + c.yy * c.zz - c.yz * c.yz;
  const bool sound = sum > 0.0 && min(min(c.xx, c.yy), c.zz) >= 0.0 && minor >= -1e-6 * sum * sum;
  return sound ? kSound : kNotPositive;
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
  const LensFit<T> fit = lens_fit(detail::overlap_of<T>(setup), points);
  return lens_result(setup.center, setup.frame, setup.half, fit, radius, flat);
}

}  // namespace gsf
