// Two ellipsoids brought to a frame made for their overlap (docs/theory/mvee.md): tells the cases
// with a closed answer apart, and gives the others as two quadratics with coefficients of order
// one. In double whatever the type of the data, because thin overlaps are differences of large
// terms.
#pragma once

#include "core/mvee/ellipsoid.h"

namespace gsf {

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
  return out;
}

// y^T w y + 2 b.y - 1 <= 0
template <typename T>
struct Quadric {
  Sym3<T> w;
  Vec3<T> b;
};

enum class LensKind : int {
  kNone,     // no overlap
  kKnown,    // center and shape hold the answer
  kGeneral,  // to be fitted: quadrics a and b around 0, with axes along unit vectors about one long
};

struct LensSetup {
  LensKind kind;
  Vec3<double> center;
  Mat3<double> frame;  // x = center + frame y; the answer is { |y| <= 1 } where it is known
  Vec3<double>
      half;  // lengths of the frame's axes where the best ellipsoid of the pencil is a ball
  Quadric<double> a, b;
};

namespace detail {

// Second ellipsoid where the first is the unit ball at 0 and both are diagonal:
// sum w_i (x_i - m_i)^2 <= 1.
struct DiagonalPair {
  Dvec m, w;
};

// Minimizer of lambda |x|^2 + (1 - lambda) q2(x), its value, and how much deeper in ball 1 it lies.
GSF_HOST_DEVICE double pencil(const DiagonalPair& p, double lambda, Dvec& x, double& slope) {
  double value = 0.0;
  slope = 0.0;
  for (int c = 0; c < 3; ++c) {
    const double b = (1.0 - lambda) * p.w[c], inverse = 1.0 / (lambda + b);
    x[c] = b * p.m[c] * inverse;
    const double off = -lambda * p.m[c] * inverse;  // x - m
    value += lambda * x[c] * x[c] + b * off * off;
    slope += x[c] * x[c] - p.w[c] * off * off;
  }
  return value;
}

// Largest sum w_i (x_i - m_i)^2 over the unit ball. The multiplier of the stationary points solves
// sum (g_i / (l - w_i))^2 = 1, g = w m, above the largest w: Newton on its inverse square root.
GSF_HOST_DEVICE double farthest(const DiagonalPair& p) {
  using std::abs;
  using std::sqrt;
  int top = 0;
  for (int c = 1; c < 3; ++c)
    if (p.w[c] > p.w[top]) top = c;
  const Dvec g{p.w.x * p.m.x, p.w.y * p.m.y, p.w.z * p.m.z};
  double l = p.w[top] * (1.0 + 1e-15) + abs(g[top]);
  for (int i = 0; i < 30; ++i) {
    double f = 0.0, df = 0.0;
    for (int c = 0; c < 3; ++c) {
      const double inverse = 1.0 / (l - p.w[c] + 1e-300), x = g[c] * inverse;
      f += x * x;
      df += x * x * inverse;
    }
    if (!(f > 1.0 + 1e-14) || !finite(f)) break;
    l += (sqrt(f) - 1.0) * f / df;
  }
  Dvec x;
  double rest = 1.0, value = 0.0;
  for (int c = 0; c < 3; ++c) {
    if (c == top) continue;
    x[c] = -g[c] / max(l - p.w[c], 1e-300);
    if (!finite(x[c]) || abs(x[c]) > 1.0) x[c] = x[c] > 0.0 ? 1.0 : -1.0;
    rest -= x[c] * x[c];
  }
  x[top] = g[top] > 0.0 ? -sqrt(max(rest, 0.0)) : sqrt(max(rest, 0.0));
  for (int c = 0; c < 3; ++c) value += p.w[c] * (x[c] - p.m[c]) * (x[c] - p.m[c]);
  return value;
}

// Interval in which x + t d lies in { sum w (x - m)^2 <= 1 }, narrowed into [lo, hi]; x lies
// inside.
GSF_HOST_DEVICE void chord(const Dvec& w, const Dvec& m, const Dvec& x, const Dvec& d, double& lo,
                           double& hi) {
  using std::sqrt;
  double a = 0.0, b = 0.0, c = -1.0;
  for (int i = 0; i < 3; ++i) {
    a += w[i] * d[i] * d[i];
    b += w[i] * d[i] * (x[i] - m[i]);
    c += w[i] * (x[i] - m[i]) * (x[i] - m[i]);
  }
  c = min(c, 0.0);
  const double root = sqrt(b * b - a * c);
  hi = min(hi, b > 0.0 ? -c / (b + root) : (root - b) / a);
  lo = max(lo, b > 0.0 ? -(b + root) / a : c / (root - b));
}

// Frame of a general overlap, given a point inside both.
GSF_HOST_DEVICE void lens_frame(const DiagonalPair& pair, const Dvec& inside, const Dmat& to_world,
                                const Dvec& origin, LensSetup& out) {
  using std::abs;
  using std::sqrt;
  const Dvec one{1.0, 1.0, 1.0}, zero{0.0, 0.0, 0.0};
  // Smallest ellipsoid lambda q1 + (1 - lambda) q2 <= 1 around the overlap: bisect the slope of the
  // logarithm of its volume.
  double lo = 0.0, hi = 1.0, slope, lambda = 0.5;
  Dvec x;
  for (int i = 0; i < 24; ++i) {
    lambda = 0.5 * (lo + hi);
    const double v = pencil(pair, lambda, x, slope);
    double rise = -1.5 * slope / max(1.0 - v, 1e-15);
    for (int c = 0; c < 3; ++c)
      rise -= 0.5 * (1.0 - pair.w[c]) / (lambda + (1.0 - lambda) * pair.w[c]);
    (rise > 0.0 ? hi : lo) = lambda;
  }
  const double v = pencil(pair, lambda, x, slope);
  Dvec reach;  // its semi-axes
  for (int c = 0; c < 3; ++c)
    reach[c] = sqrt(max(1.0 - v, 1e-15) / (lambda + (1.0 - lambda) * pair.w[c]));
  // There the two normals are opposite: the axis of the flat direction, in units of the semi-axes.
  Dvec n{reach.x * x.x, reach.y * x.y, reach.z * x.z};
  const double length = norm(n);
  n = length > 1e-12 ? (1.0 / length) * n : Dvec{1.0, 0.0, 0.0};
  const int least =
      abs(n.x) < abs(n.y) ? (abs(n.x) < abs(n.z) ? 0 : 2) : (abs(n.y) < abs(n.z) ? 1 : 2);
  Dvec side = zero;
  side[least] = 1.0;
  side = side - n[least] * n;
  side = (1.0 / norm(side)) * side;
  Dvec axes[3] = {n, side, cross(n, side)};
  for (int k = 0; k < 3; ++k)
    for (int c = 0; c < 3; ++c) axes[k][c] *= reach[c];
  // Middles of chords along the axes, over and over: a point well inside.
  Dvec p = inside;
  for (int i = 0; i < 9; ++i) {
    const int k = i % 3;
    double t0 = -1e30, t1 = 1e30;
    chord(one, zero, p, axes[k], t0, t1);
    chord(pair.w, pair.m, p, axes[k], t0, t1);
    p = p + (0.5 * (t0 + t1)) * axes[k];
  }
  double ca = -1.0, cb = -1.0;
  for (int c = 0; c < 3; ++c) {
    ca += p[c] * p[c];
    cb += pair.w[c] * (p[c] - pair.m[c]) * (p[c] - pair.m[c]);
  }
  for (int k = 0; k < 3; ++k) {
    double t0 = -1e30, t1 = 1e30;
    chord(one, zero, p, axes[k], t0, t1);
    chord(pair.w, pair.m, p, axes[k], t0, t1);
    out.half[k] = max(0.5 * (t1 - t0), 1e-12);
    axes[k] = out.half[k] * axes[k];
  }
  const auto quadric = [&](const Dvec& w, const Dvec& m, double c) {
    const double scale = 1.0 / max(-c, 1e-15);
    const auto form = [&](const Dvec& g, const Dvec& h) {
      return scale * (w.x * g.x * h.x + w.y * g.y * h.y + w.z * g.z * h.z);
    };
    const Dvec off = p - m;
    return Quadric<double>{{form(axes[0], axes[0]), form(axes[1], axes[1]), form(axes[2], axes[2]),
                            form(axes[0], axes[1]), form(axes[0], axes[2]), form(axes[1], axes[2])},
                           {form(axes[0], off), form(axes[1], off), form(axes[2], off)}};
  };
  out.a = quadric(one, zero, ca);
  out.b = quadric(pair.w, pair.m, cb);
  Dmat local;
  for (int k = 0; k < 3; ++k) set_column(local, k, axes[k]);
  out.frame = matmul(to_world, local);
  out.center = origin + matvec(to_world, p);
}

}  // namespace detail

// Relative difference of radii up to which two shapes count as equal, in units of the depth of the
// overlap: the larger radius is taken, which costs about this much volume.
inline constexpr double kLensSame = 1e-4;

// Gaussians (mean, covariance) stand for their `radius`-sigma ellipsoids. `flat` is the least axial
// over radial semi-axis of a lens.
GSF_HOST_DEVICE LensSetup lens_setup(const Vec3<double>& mean_a, const Sym3<double>& cov_a,
                                     const Vec3<double>& mean_b, const Sym3<double>& cov_b,
                                     double radius, double flat) {
  using detail::Dmat;
  using detail::Dvec;
  using std::abs;
  using std::sqrt;
  LensSetup out;
  out.kind = LensKind::kNone;
  out.center = 0.5 * (mean_a + mean_b);
  out.frame = {};

  // Frame in which ellipsoid a is the unit ball: x = mean_a + t y.
  const double r2 = radius * radius;
  const Dmat t = detail::cholesky3(r2 * cov_a), t_inv = detail::lower_inverse(t);
  const Dvec offset = matvec(t_inv, mean_b - mean_a);
  const Dmat b = r2 * matmul(matmul(t_inv, to_mat3(cov_b)), transpose(t_inv));
  const double third = (b(0, 0) + b(1, 1) + b(2, 2)) / 3.0;
  const double dx = b(0, 0) - third, dy = b(1, 1) - third, dz = b(2, 2) - third;
  const double spread = sqrt(dx * dx + dy * dy + dz * dz +
                             2.0 * (b(0, 1) * b(0, 1) + b(0, 2) * b(0, 2) + b(1, 2) * b(1, 2)));
  const double distance = norm(offset);
  const double wide = sqrt(third + spread), narrow = sqrt(max(third - spread, 0.0));
  const double depth = min(min(1.0 + narrow - distance, 2.0 * narrow), 2.0);
  if (wide - narrow <= max(kLensSame * depth, 1e-13 * wide)) {  // two balls
    const BallLens<double> lens = ball_lens(1.0, wide, distance);
    if (!lens.overlap) return out;
    const Dvec axis = distance > 0.0 ? (1.0 / distance) * offset : Dvec{1.0, 0.0, 0.0};
    out.kind = LensKind::kKnown;
    out.center = mean_a + lens.center * matvec(t, axis);
    const double axial = max(lens.axial, flat * lens.radial);
    Dmat root;  // of the shape
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j)
        root(i, j) = (axial - lens.radial) * axis[i] * axis[j] + (i == j ? lens.radial : 0.0);
    out.frame = matmul(t, root);
    return out;
  }

  const Svd3<double> eigen = svd3(b);
  detail::DiagonalPair pair;
  pair.m = matvec(transpose(eigen.u), offset);
  const double thinnest = eigen.sigma.x * 1e-20 + 1e-300;
  for (int c = 0; c < 3; ++c) pair.w[c] = 1.0 / max(abs(eigen.sigma[c]), thinnest);

  // Deepest point of both: the maximum over lambda of a concave function, by its slope.
  double lo = 0.0, hi = 1.0, slope, v = 0.0;
  Dvec inside;
  for (int i = 0; i < 52; ++i) {
    const double lambda = 0.5 * (lo + hi);
    v = detail::pencil(pair, lambda, inside, slope);
    (slope > 0.0 ? lo : hi) = lambda;
  }
  if (!(v < 1.0 - 1e-12)) return out;

  // One inside the other? The inner one's semi-axes must all be the smaller ones.
  if (max(max(pair.w.x, pair.w.y), pair.w.z) <= 1.0 && detail::farthest(pair) <= 1.0 + 1e-12) {
    out.kind = LensKind::kKnown;
    out.center = mean_a;
    out.frame = t;
    return out;
  }
  if (min(min(pair.w.x, pair.w.y), pair.w.z) >= 1.0) {
    // b as the unit ball: z = sqrt(w) (x - m), and a is sum (z_i / sqrt(w_i) + m_i)^2 <= 1.
    detail::DiagonalPair other;
    for (int c = 0; c < 3; ++c) {
      other.w[c] = 1.0 / pair.w[c];
      other.m[c] = -pair.m[c] * sqrt(pair.w[c]);
    }
    if (detail::farthest(other) <= 1.0 + 1e-12) {
      out.kind = LensKind::kKnown;
      out.center = mean_b;
      out.frame = detail::cholesky3(r2 * cov_b);
      return out;
    }
  }
  out.kind = LensKind::kGeneral;
  detail::lens_frame(pair, inside, matmul(t, eigen.u), mean_a, out);
  return out;
}

}  // namespace gsf
