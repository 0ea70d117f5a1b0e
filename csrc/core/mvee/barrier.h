// Smallest ellipsoid around points by a primal-dual interior-point method on the lifted problem:
// minimize -log det H subject to q_i^T H q_i <= 1, q = (y, 1), H symmetric 4x4
// (docs/theory/mvee.md). Ten unknowns whatever the number of points; about ten steps whatever the
// accuracy.
#pragma once

#include "core/sym3.h"

namespace gsf {

// The team of one. A "team" of lanes shares the points; every lane ends with the same ellipsoid.
struct SerialTeam {
  GSF_HOST_DEVICE int rank() const { return 0; }
  GSF_HOST_DEVICE int size() const { return 1; }
  GSF_HOST_DEVICE void sync() const {}
  template <typename T>
  GSF_HOST_DEVICE T sum(T x) const {
    return x;
  }
  // Largest value of the team and its index (the smaller index on a tie).
  template <typename T>
  GSF_HOST_DEVICE void largest(T&, int&) const {}
  template <typename T>
  GSF_HOST_DEVICE T largest(T x) const {
    return x;
  }
};

// One point of the fit: position, multiplier, slack, and the step of the latter two.
template <typename T>
struct FitPoint {
  Vec3<T> y;
  T u, s, du, ds;
};

// Cholesky factor of the lifted moments X = sum u q q^T, q = (1, y): the points' weighted mean, and
// the inverse factor of their weighted covariance times `total`, the sum of the multipliers.
template <typename T>
struct LiftedFactor {
  Vec3<T> mean;
  T k[6];  // lower triangle by rows
  T total;

  GSF_HOST_DEVICE Vec3<T> apply(const Vec3<T>& y) const {
    const Vec3<T> z = y - mean;
    return {k[0] * z.x, k[1] * z.x + k[2] * z.y, k[3] * z.x + k[4] * z.y + k[5] * z.z};
  }
  // r with { y : distance(y) <= 1 } = { mean + r z, |z| <= 1 }; lower triangle.
  GSF_HOST_DEVICE Mat3<T> root() const {
    const T a = T(1) / k[0], b = T(1) / k[2], c = T(1) / k[5];
    return {{a, T(0), T(0), -k[1] * a * b, b, T(0), (k[1] * k[4] * b - k[3]) * a * c, -k[4] * b * c,
             c}};
  }
  // q^T X^-1 q = 1 / total + distance(y)
  GSF_HOST_DEVICE T distance(const Vec3<T>& y) const {
    const Vec3<T> p = apply(y);
    return dot(p, p);
  }
};

namespace detail {

// Entry of a packed lower triangle.
GSF_HOST_DEVICE constexpr int tri(int i, int j) {
  return i >= j ? i * (i + 1) / 2 + j : j * (j + 1) / 2 + i;
}

// Index of the quartic monomial p_a p_b p_c p_d among the 35.
GSF_HOST_DEVICE constexpr int quartic(int a, int b, int c, int d) {
  int v[4] = {a, b, c, d};
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3 - i; ++j)
      if (v[j] > v[j + 1]) {
        const int t = v[j];
        v[j] = v[j + 1];
        v[j + 1] = t;
      }
  // Combinations with repetition, ranked: C(d+3,4) + C(c+2,3) + C(b+1,2) + a.
  const int w = v[3] + 3, x = v[2] + 2, y = v[1] + 1;
  return w * (w - 1) * (w - 2) * (w - 3) / 24 + x * (x - 1) * (x - 2) / 6 + y * (y - 1) / 2 + v[0];
}

// Solves (1 + quartic moments) x = b for the ten unknowns of a symmetric 4x4 (off-diagonal ones
// times sqrt 2) by Cholesky; positive definite by construction.
template <typename T>
GSF_HOST_DEVICE void solve_ten(const T (&moment)[35], T (&x)[10]) {
  using std::sqrt;
  T l[55];
  GSF_UNROLL for (int e = 0; e < 10; ++e) {
    const int b = e < 1 ? 0 : e < 3 ? 1 : e < 6 ? 2 : 3, a = e - b * (b + 1) / 2;
    GSF_UNROLL for (int f = 0; f <= e; ++f) {
      const int d = f < 1 ? 0 : f < 3 ? 1 : f < 6 ? 2 : 3, c = f - d * (d + 1) / 2;
      const T scale =
          (a == b ? T(1) : T(1.4142135623730951)) * (c == d ? T(1) : T(1.4142135623730951));
      T s = scale * moment[quartic(a, b, c, d)] + (e == f ? T(1) : T(0));
      GSF_UNROLL for (int i = 0; i < f; ++i) s -= l[tri(e, i)] * l[tri(f, i)];
      // The diagonal is kept inverted. It is at least one but for rounding.
      l[tri(e, f)] = e == f ? T(1) / sqrt(max(s, T(1e-3))) : s * l[tri(f, f)];
    }
  }
  GSF_UNROLL for (int e = 0; e < 10; ++e) {
    T s = x[e];
    GSF_UNROLL for (int i = 0; i < e; ++i) s -= l[tri(e, i)] * x[i];
    x[e] = s * l[tri(e, e)];
  }
  GSF_UNROLL for (int e = 9; e >= 0; --e) {
    T s = x[e];
    GSF_UNROLL for (int i = e + 1; i < 10; ++i) s -= l[tri(i, e)] * x[i];
    x[e] = s * l[tri(e, e)];
  }
}

}  // namespace detail

// Factor of the moments of the points. Axes from `dimension` on hold no extent: their coordinates
// are zero, and their entry counts as one.
template <typename T, class Team>
GSF_HOST_DEVICE LiftedFactor<T> lifted_factor(const Team& team, const FitPoint<T>* points, int n,
                                              int dimension) {
  using std::sqrt;
  LiftedFactor<T> r;
  T x[10] = {};
  for (int i = team.rank(); i < n; i += team.size()) {
    const FitPoint<T>& p = points[i];
    const T q[4] = {T(1), p.y.x, p.y.y, p.y.z};
    GSF_UNROLL for (int a = 0; a < 4; ++a) {
      const T uq = p.u * q[a];
      GSF_UNROLL for (int b = 0; b <= a; ++b) x[detail::tri(a, b)] += uq * q[b];
    }
  }
  GSF_UNROLL for (int e = 0; e < 10; ++e) x[e] = team.sum(x[e]);
  r.total = x[0];
  const T inverse = T(1) / r.total;
  r.mean = {x[1] * inverse, x[3] * inverse, x[6] * inverse};
  T l[6];
  GSF_UNROLL for (int i = 0; i < 3; ++i) {
    GSF_UNROLL for (int j = 0; j <= i; ++j) {
      const T raw = x[detail::tri(i + 1, j + 1)];
      T s = raw - x[detail::tri(i + 1, 0)] * r.mean[j];
      GSF_UNROLL for (int c = 0; c < j; ++c) s -= l[detail::tri(i, c)] * l[detail::tri(j, c)];
      // Inverted diagonal; the floor only matters where points coincide to rounding.
      l[detail::tri(i, j)] =
          i == j ? (i < dimension ? T(1) / sqrt(max(s, T(1e-6) * raw + T(1e-30))) : T(1))
                 : s * l[detail::tri(j, j)];
    }
  }
  GSF_UNROLL for (int i = 0; i < 3; ++i) {
    r.k[detail::tri(i, i)] = l[detail::tri(i, i)];
    GSF_UNROLL for (int j = i - 1; j >= 0; --j) {
      T s = T(0);
      GSF_UNROLL for (int c = j; c < i; ++c) s -= l[detail::tri(i, c)] * r.k[detail::tri(c, j)];
      r.k[detail::tri(i, j)] = s * l[detail::tri(i, i)];
    }
  }
  return r;
}

// Scales the multipliers so that every slack is positive, sets the slacks to their exact values,
// and returns the sum of the products: a start from which barrier_step goes well as long as no
// multiplier is much smaller than the others. `highest` is the largest distance of a point.
template <typename T, class Team>
GSF_HOST_DEVICE T barrier_start(const Team& team, FitPoint<T>* points, int n,
                                LiftedFactor<T>& factor, T highest, T room) {
  using std::sqrt;
  const T first = T(1) / factor.total, scale = (highest + first) * (T(1) + room);
  const T inverse = T(1) / scale;
  T sum = T(0);
  for (int i = team.rank(); i < n; i += team.size()) {
    FitPoint<T>& p = points[i];
    p.s = max(T(1) - (factor.distance(p.y) + first) * inverse, T(1e-6));
    p.u *= scale;
    sum += p.u * p.s;
  }
  const T root = T(1) / sqrt(scale);
  for (int e = 0; e < 6; ++e) factor.k[e] *= root;
  factor.total *= scale;
  team.sync();
  return team.sum(sum);
}

// One Newton step towards the central path, its target the fraction `centering` of the present
// mean complementarity; updates multipliers and slacks. Points may have moved since the last step:
// the slack is a variable of its own, and the step works its error off.
template <typename T, class Team>
GSF_HOST_DEVICE void barrier_step(const Team& team, FitPoint<T>* points, int n,
                                  const LiftedFactor<T>& factor, T target) {
  using std::sqrt;
  T moment[35] = {}, x[10] = {};
  const T first = T(1) / sqrt(factor.total);
  const T root2 = T(1.4142135623730951);
  for (int i = team.rank(); i < n; i += team.size()) {
    FitPoint<T>& point = points[i];
    const Vec3<T> z = factor.apply(point.y);
    const T p[4] = {first, z.x, z.y, z.z};
    T pair[10], weighted[10];
    GSF_UNROLL for (int b = 0; b < 4; ++b) GSF_UNROLL for (int a = 0; a <= b; ++a)
        pair[detail::tri(b, a)] = p[a] * p[b];
    const T m = pair[0] + pair[2] + pair[5] + pair[9];
    const T inverse = T(1) / point.s;
    const T d = point.u * inverse, r = T(1) - m - point.s;
    const T w = target * inverse - point.u - d * r;
    point.du = w;
    point.ds = r;
    GSF_UNROLL for (int e = 0; e < 10; ++e) {
      x[e] -= w * pair[e];
      weighted[e] = d * pair[e];
    }
    int k = 0;
    GSF_UNROLL for (int f = 0; f < 10; ++f) {  // f = (c <= d), e = (a <= b) with b <= c
      const int dd = f < 1 ? 0 : f < 3 ? 1 : f < 6 ? 2 : 3, c = f - dd * (dd + 1) / 2;
      GSF_UNROLL for (int e = 0; e < (c + 1) * (c + 2) / 2; ++e, ++k) moment[k] +=
          weighted[e] * pair[f];
    }
  }
  GSF_UNROLL for (int e = 0; e < 10; ++e) x[e] = team.sum(x[e]);
  GSF_UNROLL for (int k = 0; k < 35; ++k) moment[k] = team.sum(moment[k]);
  GSF_UNROLL for (int b = 0; b < 4; ++b) GSF_UNROLL for (int a = 0; a < b; ++a)
      x[detail::tri(b, a)] *= root2;
  detail::solve_ten(moment, x);
  // Twice the off-diagonal entries of the change of H (root2 of the basis times root2).
  GSF_UNROLL for (int b = 0; b < 4; ++b) GSF_UNROLL for (int a = 0; a < b; ++a)
      x[detail::tri(b, a)] *= root2;

  T shrink_u = T(0), shrink_s = T(0);  // largest relative decrease
  for (int i = team.rank(); i < n; i += team.size()) {
    FitPoint<T>& point = points[i];
    const Vec3<T> z = factor.apply(point.y);
    const T p[4] = {first, z.x, z.y, z.z};
    T along = T(0);
    GSF_UNROLL for (int b = 0; b < 4; ++b) GSF_UNROLL for (int a = 0; a <= b; ++a) along +=
        x[detail::tri(b, a)] * p[a] * p[b];
    const T inverse = T(1) / point.s;
    point.ds -= along;
    point.du += point.u * inverse * along;
    shrink_u = max(shrink_u, -point.du / point.u);
    shrink_s = max(shrink_s, -point.ds * inverse);
  }
  shrink_u = team.largest(shrink_u);
  shrink_s = team.largest(shrink_s);
  const T back = T(0.95);
  const T step_u = back / max(shrink_u, back), step_s = back / max(shrink_s, back);
  for (int i = team.rank(); i < n; i += team.size()) {
    FitPoint<T>& point = points[i];
    // Floors far below what matters: rounding must not end in a zero or negative pair.
    point.u = max(point.u + step_u * point.du, T(1e-9));
    point.s = max(point.s + step_s * point.ds, T(1e-9));
  }
  team.sync();
}

}  // namespace gsf
