// Ellipsoid around the overlap of two ellipsoids (equations.md sections 13.1 and 13.2): closed form
// for balls and for equal shapes, rays and Khachiyan otherwise.
#pragma once

#include "core/mvee.h"

namespace gsf {

inline constexpr int kLensRays = 128;       // points fitted in the general case
inline constexpr int kLensCheckRays = 512;  // rays that only widen the fit to contain them
inline constexpr double kLensDisc = 0.15;   // least axial over radial semi-axis of a ball lens
inline constexpr double kLensFlat = 1e-3;   // least semi-axis ratio of a general lens

// Where the smallest ellipsoid around the lens of two balls lies on the axis from ball 1 (radius
// r1, at 0) to ball 2 (radius r2, at distance), with its axial and radial semi-axes.
template <typename T>
struct BallLens {
  T center, axial, radial;
  bool overlap;
};

// Exact (John's conditions). Three cases by the heights of the two caps; nested and disjoint balls.
template <typename T>
GSF_HOST_DEVICE BallLens<T> ball_lens(T r1, T r2, T distance) {
  using std::abs;
  using std::sqrt;
  if (!(distance < r1 + r2)) return {T(0), T(0), T(0), false};
  if (distance <= abs(r1 - r2))
    return r1 <= r2 ? BallLens<T>{T(0), r1, r1, true} : BallLens<T>{distance, r2, r2, true};
  const T x0 = (distance * distance + r1 * r1 - r2 * r2) / (T(2) * distance);
  const T right = r1 - x0, left = x0 - (distance - r2);  // cap heights; the right cap is ball 1's
  const T rho2 = max((r1 - x0) * (r1 + x0), T(0));       // squared rim radius
  const T high = max(left, right), low = min(left, right);
  const bool right_larger = right >= left;
  const T r_big = right_larger ? r1 : r2;
  BallLens<T> out;
  out.overlap = true;
  if (high <= T(2) * low) {
    const T length = r1 + r2 - distance;
    out.axial = T(0.5) * length;
    out.radial = sqrt(rho2 * length * length / (T(4) * high * low));
    out.center = T(0.5) * (distance - r2 + r1);
  } else if (high < r_big * T(4.0 / 3.0)) {
    out.axial = T(0.75) * high;
    out.radial = sqrt(T(9.0 / 8.0) * rho2);
    out.center = x0 + (right_larger ? T(0.25) : T(-0.25)) * high;
  } else {
    out.axial = out.radial = r_big;
    out.center = right_larger ? T(0) : distance;
  }
  out.axial = max(out.axial, T(kLensDisc) * out.radial);
  return out;
}

template <typename T>
struct LensResult {
  Vec3<T> mean;
  Sym3<T> covariance;
  bool overlap;
};

namespace detail {

// Direction i of n on the unit sphere, evenly spread (Fibonacci spiral).
template <typename T>
GSF_HOST_DEVICE Vec3<T> fibonacci_direction(int i, int n) {
  using std::cos;
  using std::sin;
  using std::sqrt;
  const T z = T(1) - (T(2) * T(i) + T(1)) / T(n);
  const T angle = T(2.399963229728653) * T(i);  // golden angle
  const T r = sqrt(max(T(1) - z * z, T(0)));
  return {r * cos(angle), r * sin(angle), z};
}

// Second ellipsoid in the frame where the first is the unit ball at 0 and both are diagonal:
// sum w_i (x_i - m_i)^2 <= 1.
template <typename T>
struct DiagonalPair {
  Vec3<T> m, w;
};

// Maximizer over lambda of min_x lambda |x|^2 + (1 - lambda) q2(x): its x lies deepest in both.
template <typename T>
GSF_HOST_DEVICE T deepest_point(const DiagonalPair<T>& p, Vec3<T>& x) {
  const auto depth = [&](T lambda, Vec3<T>& at) {
    T value = T(0);
    for (int c = 0; c < 3; ++c) {
      const T b = (T(1) - lambda) * p.w[c];
      at[c] = b * p.m[c] / (lambda + b);
      const T off = at[c] - p.m[c];
      value += lambda * at[c] * at[c] + b * off * off;
    }
    return value;
  };
  const T golden = T(0.6180339887498949);
  T lo = T(1e-6), hi = T(1) - T(1e-6);
  T a = hi - golden * (hi - lo), b = lo + golden * (hi - lo);
  Vec3<T> xa, xb;
  T fa = depth(a, xa), fb = depth(b, xb);
  for (int i = 0; i < 40; ++i) {
    if (fa > fb) {
      hi = b;
      b = a;
      fb = fa;
      a = hi - golden * (hi - lo);
      fa = depth(a, xa);
    } else {
      lo = a;
      a = b;
      fa = fb;
      b = lo + golden * (hi - lo);
      fb = depth(b, xb);
    }
  }
  return depth(T(0.5) * (lo + hi), x);
}

// Distance along v from the inner point x to the nearer of the two surfaces; `second` says which.
template <typename T>
GSF_HOST_DEVICE T exit_distance(const DiagonalPair<T>& p, const Vec3<T>& x, const Vec3<T>& v,
                                bool& second) {
  using std::sqrt;
  T t[2];
  for (int e = 0; e < 2; ++e) {
    T a = T(0), b = T(0), c = T(-1);
    for (int i = 0; i < 3; ++i) {
      const T w = e == 0 ? T(1) : p.w[i];
      const T off = x[i] - (e == 0 ? T(0) : p.m[i]);
      a += w * v[i] * v[i];
      b += w * v[i] * off;
      c += w * off * off;
    }
    c = min(c, T(0));
    const T root = sqrt(b * b - a * c);
    t[e] = b > T(0) ? -c / (b + root) : (root - b) / a;  // no cancellation on either side
  }
  second = t[1] < t[0];
  return min(t[0], t[1]);
}

}  // namespace detail

// Gaussians (mean, covariance) stand for their `radius`-sigma ellipsoids; the result is a Gaussian
// in the same sense. `points` is scratch of 3 kLensRays values, `weight` of kLensRays, shared by
// the team. Without overlap the covariance is zero and the mean the midpoint.
template <typename T, class Team>
GSF_HOST_DEVICE LensResult<T> mvee_lens(const Team& team, const Vec3<T>& mean_a,
                                        const Sym3<T>& cov_a, const Vec3<T>& mean_b,
                                        const Sym3<T>& cov_b, T radius, T* points, T* weight) {
  using std::abs;
  using std::sqrt;
  const LensResult<T> none{T(0.5) * (mean_a + mean_b), {T(0), T(0), T(0), T(0), T(0), T(0)}, false};

  // Frame in which ellipsoid a is the unit ball: x = mean_a + t y.
  const Svd3<T> ea = svd3(to_mat3(cov_a));
  Mat3<T> t, t_inv;
  const T least = max(ea.sigma.x, T(0)) * (sizeof(T) == 4 ? T(1e-10) : T(1e-24)) + T(1e-30);
  for (int c = 0; c < 3; ++c) {
    const T half = radius * sqrt(max(abs(ea.sigma[c]), least));
    const Vec3<T> axis = detail::column(ea.u, c);
    detail::set_column(t, c, half * axis);
    for (int i = 0; i < 3; ++i) t_inv(c, i) = axis[i] / half;
  }
  const Vec3<T> offset = matvec(t_inv, mean_b - mean_a);
  const Mat3<T> shape_b =
      (radius * radius) * matmul(matmul(t_inv, to_mat3(cov_b)), transpose(t_inv));
  const Svd3<T> eb = svd3(shape_b);

  const T same = sizeof(T) == 4 ? T(1e-4) : T(1e-10);
  Vec3<T> center;
  Mat3<T> shape;
  if (eb.sigma.x - eb.sigma.z <= same * eb.sigma.x) {
    // Equal shapes: two balls.
    const T distance = norm(offset);
    const T r2 = sqrt((eb.sigma.x + eb.sigma.y + eb.sigma.z) / T(3));
    const BallLens<T> lens = ball_lens(T(1), r2, distance);
    if (!lens.overlap) return none;
    const Vec3<T> axis = distance > T(0) ? (T(1) / distance) * offset : Vec3<T>{T(1), T(0), T(0)};
    center = lens.center * axis;
    const T b2 = lens.radial * lens.radial, a2 = lens.axial * lens.axial;
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j)
        shape(i, j) = (a2 - b2) * axis[i] * axis[j] + (i == j ? b2 : T(0));
  } else {
    detail::DiagonalPair<T> pair;
    pair.m = matvec(transpose(eb.u), offset);
    const T thinnest = eb.sigma.x * (sizeof(T) == 4 ? T(1e-10) : T(1e-24)) + T(1e-30);
    for (int c = 0; c < 3; ++c) pair.w[c] = T(1) / max(abs(eb.sigma[c]), thinnest);
    Vec3<T> inner;
    if (!(detail::deepest_point(pair, inner) < T(1))) return none;
    // Rays shaped like the ellipsoids together, so that thin lenses get even spacing too.
    const auto ray = [&](int i, int n, bool& second) {
      Vec3<T> v = detail::fibonacci_direction<T>(i, n);
      for (int c = 0; c < 3; ++c) v[c] /= sqrt(T(1) + pair.w[c]);
      return inner + detail::exit_distance(pair, inner, v, second) * v;
    };
    T hits = T(0);
    for (int i = team.rank(); i < kLensRays; i += team.size()) {
      bool second;
      const Vec3<T> x = ray(i, kLensRays, second);
      for (int c = 0; c < 3; ++c) points[3 * i + c] = x[c];
      hits += second ? T(1) : T(0);
    }
    hits = team.sum(hits);
    team.sync();
    if (hits == T(0)) {  // every ray leaves a first: a lies inside b
      center = {T(0), T(0), T(0)};
      shape = identity3<T>();
    } else if (hits == T(kLensRays)) {
      center = offset;
      shape = shape_b;
    } else {
      const Ellipsoid<T> fit = mvee_fit(team, points, kLensRays, weight, T(1e-3), 500);
      // Widen to contain a finer set of rays, and keep the thinnest axis off zero.
      const Svd3<T> ef = svd3(to_mat3(fit.shape));
      const T floor = T(kLensFlat * kLensFlat) * ef.sigma.x;
      const Vec3<T> s2{ef.sigma.x, max(ef.sigma.y, floor), max(ef.sigma.z, floor)};
      T reach = T(1);
      int unused = 0;
      for (int i = team.rank(); i < kLensCheckRays; i += team.size()) {
        bool second;
        const Vec3<T> x = ray(i, kLensCheckRays, second) - fit.center;
        T q = T(0);
        for (int c = 0; c < 3; ++c) {
          const T y = dot(detail::column(ef.u, c), x);
          q += y * y / s2[c];
        }
        reach = max(reach, q);
      }
      team.largest(reach, unused);
      const Mat3<T> local = compose_svd(ef.u, reach * s2, ef.u);
      center = matvec(eb.u, fit.center);
      shape = matmul(matmul(eb.u, local), transpose(eb.u));
    }
  }
  const Mat3<T> s = matmul(matmul(t, shape), transpose(t));
  const T k = T(1) / (radius * radius);
  return {mean_a + matvec(t, center),
          {k * s(0, 0), k * s(1, 1), k * s(2, 2), k * s(0, 1), k * s(0, 2), k * s(1, 2)},
          true};
}

}  // namespace gsf
