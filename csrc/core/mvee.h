// Minimum-volume enclosing ellipsoid of one point set: Khachiyan's algorithm with away steps
// (equations.md section 13.2; Todd and Yildirim 2007). A "team" of lanes shares the points: one
// lane on the CPU, a warp on the GPU; every lane ends with the same ellipsoid.
#pragma once

#include "core/svd3.h"
#include "core/sym3.h"

namespace gsf {

// { x : (x - center)^T shape^-1 (x - center) <= 1 }
template <typename T>
struct Ellipsoid {
  Vec3<T> center;
  Sym3<T> shape;
};

// The team of one.
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
};

namespace detail {

// Symmetric 4x4, lower triangle by rows.
template <typename T>
struct Sym4 {
  T m[10];
  GSF_HOST_DEVICE T& at(int i, int j) {
    return i >= j ? m[i * (i + 1) / 2 + j] : m[j * (j + 1) / 2 + i];
  }
  GSF_HOST_DEVICE T at(int i, int j) const {
    return i >= j ? m[i * (i + 1) / 2 + j] : m[j * (j + 1) / 2 + i];
  }
};

// Inverse of a positive definite matrix by Cholesky.
template <typename T>
GSF_HOST_DEVICE Sym4<T> inverse(const Sym4<T>& a) {
  using std::sqrt;
  T l[4][4] = {}, k[4][4] = {};  // a = l l^T, k = l^-1
  for (int i = 0; i < 4; ++i)
    for (int j = 0; j <= i; ++j) {
      T s = a.at(i, j);
      for (int c = 0; c < j; ++c) s -= l[i][c] * l[j][c];
      l[i][j] = i == j ? sqrt(max(s, T(1e-30))) : s / l[j][j];
    }
  for (int i = 0; i < 4; ++i) {
    k[i][i] = T(1) / l[i][i];
    for (int j = 0; j < i; ++j) {
      T s = T(0);
      for (int c = j; c < i; ++c) s -= l[i][c] * k[c][j];
      k[i][j] = s / l[i][i];
    }
  }
  Sym4<T> r;
  for (int i = 0; i < 4; ++i)
    for (int j = 0; j <= i; ++j) {
      T s = T(0);
      for (int c = i; c < 4; ++c) s += k[c][i] * k[c][j];
      r.at(i, j) = s;
    }
  return r;
}

template <typename T>
GSF_HOST_DEVICE T quadratic(const Sym4<T>& a, const Vec3<T>& y) {
  return y.x * (a.m[0] * y.x + T(2) * (a.m[1] * y.y + a.m[3] * y.z + a.m[6])) +
         y.y * (a.m[2] * y.y + T(2) * (a.m[4] * y.z + a.m[7])) +
         y.z * (a.m[5] * y.z + T(2) * a.m[8]) + a.m[9];
}

// Mean and principal axes of the points, and how many of the axes carry any extent.
template <typename T>
struct Principal {
  Vec3<T> mean;
  Mat3<T> axes;       // columns
  Vec3<T> deviation;  // standard deviation along each
  int rank;
};

template <typename T, class Team>
GSF_HOST_DEVICE Principal<T> principal(const Team& team, const T* points, int n) {
  using std::abs;
  using std::sqrt;
  Principal<T> r;
  T s[3] = {}, largest = T(0);
  for (int j = team.rank(); j < n; j += team.size())
    for (int c = 0; c < 3; ++c) s[c] += points[3 * j + c] / T(n);
  r.mean = {team.sum(s[0]), team.sum(s[1]), team.sum(s[2])};
  T v[6] = {};
  for (int j = team.rank(); j < n; j += team.size()) {
    const Vec3<T> y = Vec3<T>{points[3 * j], points[3 * j + 1], points[3 * j + 2]} - r.mean;
    const T entry[6] = {y.x * y.x, y.y * y.y, y.z * y.z, y.x * y.y, y.x * y.z, y.y * y.z};
    for (int c = 0; c < 6; ++c) v[c] += entry[c] / T(n);
  }
  for (int c = 0; c < 6; ++c) v[c] = team.sum(v[c]);
  const Svd3<T> eigen = svd3(to_mat3(load_sym3(v)));
  r.axes = eigen.u;
  for (int c = 0; c < 3; ++c) r.deviation[c] = sqrt(max(abs(eigen.sigma[c]), T(0)));
  largest = max(max(abs(r.mean.x), abs(r.mean.y)), abs(r.mean.z));
  // Below this ratio the covariance holds rounding, and the set counts as flat in that direction.
  const T flat = sizeof(T) == 4 ? T(1e-3) : T(1e-7);
  const T eps = sizeof(T) == 4 ? T(1e-6) : T(1e-14);
  const T least = max(flat * r.deviation.x, eps * largest);
  r.rank = (r.deviation.x > least) + (r.deviation.y > least) + (r.deviation.z > least);
  return r;
}

}  // namespace detail

// Smallest semi-axis of a flat or single-point fit, relative to the largest one: keeps the shape
// matrix positive definite.
inline constexpr double kMveeFlatAxis = 1e-4;

// Fits `n` >= 1 points ([n, 3], finite) to a relative gap of `tolerance` in the optimality
// conditions, then scales the result to contain every point. `weight` is scratch of n values.
template <typename T, class Team>
GSF_HOST_DEVICE Ellipsoid<T> mvee_fit(const Team& team, const T* points, int n, T* weight,
                                      T tolerance, int max_iterations) {
  using std::abs;
  using std::sqrt;
  const detail::Principal<T> frame = detail::principal(team, points, n);
  const int d = frame.rank;
  const T full = T(d + 1);
  // Coordinates along the axes in standard deviations; zero along flat axes.
  const auto local = [&](int j) {
    const Vec3<T> x = Vec3<T>{points[3 * j], points[3 * j + 1], points[3 * j + 2]} - frame.mean;
    Vec3<T> y{T(0), T(0), T(0)};
    for (int c = 0; c < d; ++c) y[c] = dot(detail::column(frame.axes, c), x) / frame.deviation[c];
    return y;
  };

  // Start from two extreme points in each of d independent directions (Kumar and Yildirim 2005):
  // their affine hull is the whole space, and few weights need to be driven out again.
  int start[6];
  Vec3<T> v{T(1), T(0), T(0)}, across{T(0), T(0), T(0)};
  for (int c = 0; c < d; ++c) {
    T ahead = T(-1e30), behind = T(-1e30);
    int j_ahead = n, j_behind = n;
    for (int j = team.rank(); j < n; j += team.size()) {
      const T along = dot(v, local(j));
      if (along > ahead) {
        ahead = along;
        j_ahead = j;
      }
      if (-along > behind) {
        behind = -along;
        j_behind = j;
      }
    }
    team.largest(ahead, j_ahead);
    team.largest(behind, j_behind);
    start[2 * c] = min(j_ahead, n - 1);
    start[2 * c + 1] = min(j_behind, n - 1);
    const Vec3<T> difference = local(start[2 * c]) - local(start[2 * c + 1]);
    // The next direction is orthogonal to the differences so far (the first has x > 0).
    v = c == 0 ? Vec3<T>{-difference.y, difference.x, T(0)} : cross(across, difference);
    across = difference;
  }
  for (int j = team.rank(); j < n; j += team.size()) {
    int times = 0;
    for (int c = 0; c < 2 * d; ++c) times += start[c] == j;
    weight[j] = d > 0 ? T(times) / T(2 * d) : T(1) / T(n);
  }
  team.sync();
  detail::Sym4<T> inv;
  for (int iteration = 0; d > 0 && iteration < max_iterations; ++iteration) {
    if (iteration % 16 == 0) {  // rank-one updates below drift
      detail::Sym4<T> x{};
      for (int j = team.rank(); j < n; j += team.size()) {
        const Vec3<T> y = local(j);
        const T q[4] = {y.x, y.y, y.z, T(1)};
        for (int a = 0, e = 0; a < 4; ++a)
          for (int b = 0; b <= a; ++b, ++e) x.m[e] += weight[j] * q[a] * q[b];
      }
      for (int e = 0; e < 10; ++e) x.m[e] = team.sum(x.m[e]);
      // So does the sum of the weights (the last entry), which is one by definition.
      const T total = T(1) / x.m[9];
      for (int e = 0; e < 10; ++e) x.m[e] *= total;
      for (int j = team.rank(); j < n; j += team.size()) weight[j] *= total;
      team.sync();
      for (int c = d; c < 3; ++c) x.at(c, c) = T(1);  // flat axes: any value, their y is zero
      inv = detail::inverse(x);
    }
    T high = T(-1), low = T(-1e30);  // low holds -M, so that one reduction serves both
    int j_high = n, j_low = n;
    for (int j = team.rank(); j < n; j += team.size()) {
      const T m = detail::quadratic(inv, local(j));
      if (m > high) {
        high = m;
        j_high = j;
      }
      if (weight[j] > T(0) && -m > low) {
        low = -m;
        j_low = j;
      }
    }
    team.largest(high, j_high);
    team.largest(low, j_low);
    if (j_high >= n || j_low >= n) break;
    const T excess = high - full, slack = full + low;
    if (max(excess, slack) <= tolerance * full) break;
    const bool toward = excess >= slack;
    const int pivot = toward ? j_high : j_low;
    const T m = toward ? high : -low;
    // Optimal step along the line to (or away from) the pivot; away stops where its weight is gone.
    T step = (m - full) / (full * (m - T(1)));
    bool drop = false;
    if (!toward) {
      const T gone = -weight[pivot] / (T(1) - weight[pivot]);
      drop = !(m > T(1)) || step <= gone;
      step = drop ? gone : step;
      if (!(weight[pivot] < T(1))) break;
    }
    team.sync();
    for (int j = team.rank(); j < n; j += team.size()) {
      const T w = (T(1) - step) * weight[j] + (j == pivot ? step : T(0));
      // Exactly zero, or the rounding left behind would be chosen to be dropped for ever.
      weight[j] = w > T(0) && !(drop && j == pivot) ? w : T(0);
    }
    team.sync();
    const Vec3<T> y = local(pivot);
    T q[4] = {y.x, y.y, y.z, T(1)}, g[4];
    for (int a = 0; a < 4; ++a) {
      g[a] = T(0);
      for (int b = 0; b < 4; ++b) g[a] += inv.at(a, b) * q[b];
    }
    const T f = step / ((T(1) - step) + step * m);
    for (int a = 0, e = 0; a < 4; ++a)
      for (int b = 0; b <= a; ++b, ++e) inv.m[e] = (inv.m[e] - f * g[a] * g[b]) / (T(1) - step);
    // The identity entries of flat axes scale like the rest but are never read.
  }

  // Centre and shape from the weights, in local coordinates.
  T c[3] = {}, moment[6] = {};
  for (int j = team.rank(); j < n; j += team.size()) {
    const Vec3<T> y = local(j);
    for (int a = 0; a < 3; ++a) c[a] += weight[j] * y[a];
  }
  const Vec3<T> center{team.sum(c[0]), team.sum(c[1]), team.sum(c[2])};
  for (int j = team.rank(); j < n; j += team.size()) {
    const Vec3<T> y = local(j) - center;
    const T entry[6] = {y.x * y.x, y.y * y.y, y.z * y.z, y.x * y.y, y.x * y.z, y.y * y.z};
    for (int a = 0; a < 6; ++a) moment[a] += T(d) * weight[j] * entry[a];
  }
  for (int a = 0; a < 6; ++a) moment[a] = team.sum(moment[a]);
  Mat3<T> s = to_mat3(load_sym3(moment));
  Vec3<T> middle = frame.mean;
  for (int a = 0; a < d; ++a)
    middle = middle + (frame.deviation[a] * center[a]) * detail::column(frame.axes, a);

  // Flat axes: the little extent the points have, doubled thrice so that the final scaling stays
  // within 2 percent, but at least a sliver of the longest axis.
  Vec3<T> scale = frame.deviation;
  T longest = T(0);
  for (int a = 0; a < d; ++a) longest = max(longest, scale[a] * sqrt(max(s(a, a), T(0))));
  const T size = max(max(abs(middle.x), abs(middle.y)), abs(middle.z));
  const T eps = sizeof(T) == 4 ? T(1e-6) : T(1e-14);
  const T sliver = max(max(T(kMveeFlatAxis) * longest, eps * size), T(1e-18));
  for (int a = d; a < 3; ++a) {
    T extent = T(0);
    int unused = 0;
    for (int j = team.rank(); j < n; j += team.size()) {
      const Vec3<T> x = Vec3<T>{points[3 * j], points[3 * j + 1], points[3 * j + 2]} - middle;
      extent = max(extent, abs(dot(detail::column(frame.axes, a), x)));
    }
    team.largest(extent, unused);
    scale[a] = max(T(8) * extent, sliver);
    s(a, a) = T(1);
  }

  // Scale to contain every point, by the Cholesky inverse of s.
  detail::Sym4<T> whole{};
  for (int a = 0; a < 3; ++a)
    for (int b = 0; b <= a; ++b) whole.at(a, b) = s(a, b);
  whole.at(3, 3) = T(1);
  const detail::Sym4<T> s_inv = detail::inverse(whole);
  T reach = T(0);
  int unused = 0;
  for (int j = team.rank(); j < n; j += team.size()) {
    const Vec3<T> x = Vec3<T>{points[3 * j], points[3 * j + 1], points[3 * j + 2]} - middle;
    Vec3<T> y{};
    for (int a = 0; a < 3; ++a) y[a] = dot(detail::column(frame.axes, a), x) / scale[a];
    reach = max(reach, detail::quadratic(s_inv, y) - T(1));  // the lifted 1 adds one
  }
  team.largest(reach, unused);
  const T grow = max(reach, T(1)) * (T(1) + T(16) * eps);

  Ellipsoid<T> out;
  out.center = middle;
  Mat3<T> t;  // axes * diag(scale)
  for (int a = 0; a < 3; ++a) detail::set_column(t, a, scale[a] * detail::column(frame.axes, a));
  const Mat3<T> r = matmul(matmul(t, s), transpose(t));
  out.shape = {grow * r(0, 0), grow * r(1, 1), grow * r(2, 2),
               grow * r(0, 1), grow * r(0, 2), grow * r(1, 2)};
  return out;
}

}  // namespace gsf
