// Axes of a Gaussian: from its covariance, and as the matter it rides on turns and stretches it.
#pragma once

#include "core/deform/args.h"
#include "core/raster/splat.h"
#include "core/svd3.h"

namespace gsf {

constexpr double kLeastAxis = 1e-6;  // of the longest: a flattened Gaussian stays thin, not NaN

// Unit quaternion wxyz, w >= 0, of a rotation; divides by its largest component (Shepperd 1978).
template <typename T>
GSF_HOST_DEVICE void quat_from_rotation(const Mat3<T>& m, T* q) {
  using std::sqrt;
  const T square[4] = {T(1) + m(0, 0) + m(1, 1) + m(2, 2), T(1) + m(0, 0) - m(1, 1) - m(2, 2),
                       T(1) - m(0, 0) + m(1, 1) - m(2, 2), T(1) - m(0, 0) - m(1, 1) + m(2, 2)};
  const T a = m(2, 1) - m(1, 2), b = m(0, 2) - m(2, 0), c = m(1, 0) - m(0, 1);
  const T d = m(1, 0) + m(0, 1), e = m(0, 2) + m(2, 0), f = m(2, 1) + m(1, 2);
  T w = square[0], x = a, y = b, z = c, most = square[0];
  const auto take = [&](T s, T w1, T x1, T y1, T z1) {
    if (!(s > most)) return;
    most = s;
    w = w1;
    x = x1;
    y = y1;
    z = z1;
  };
  take(square[1], a, square[1], d, e);
  take(square[2], b, d, square[2], f);
  take(square[3], c, e, f, square[3]);
  const T length = sqrt(w * w + x * x + y * y + z * z);
  const T scale = (w < T(0) ? T(-1) : T(1)) / length;
  q[0] = scale * w;
  q[1] = scale * x;
  q[2] = scale * y;
  q[3] = scale * z;
}

// Quaternion and axes of the ellipsoid that a map makes of the unit ball: map = U diag(s) V^T. No
// axis is less than `share` of the longest.
template <typename T>
GSF_HOST_DEVICE void ellipsoid_axes(const Mat3<T>& map, T share, T* quat, T* scales) {
  using std::abs;
  const Svd3<T> d = svd3(map);
  quat_from_rotation(d.u, quat);
  const T least = share * abs(d.sigma.x);
  for (int k = 0; k < 3; ++k) scales[k] = max(abs(d.sigma[k]), least);
}

template <typename T>
GSF_HOST_DEVICE bool finite(const Mat3<T>& m) {
  T sum = T(0);
  for (int i = 0; i < 9; ++i) sum += m.m[i] - m.m[i];
  return sum == T(0);
}

// Covariance to axes; what is not finite becomes the identity and scales of zero.
template <typename T>
GSF_HOST_DEVICE void covariance_axes(const CovarianceAxesArgs<T>& a, int64_t i) {
  using std::sqrt;
  T *quat = a.quats + 4 * i, *scales = a.scales + 3 * i;
  const Mat3<T> c = to_mat3(load_sym3(a.covariance + 6 * i));
  if (!finite(c)) {
    for (int k = 0; k < 4; ++k) quat[k] = T(k == 0);
    for (int k = 0; k < 3; ++k) scales[k] = T(0);
    return;
  }
  // Of a symmetric matrix the singular values are the eigenvalues, squares of the axes.
  ellipsoid_axes(c, T(kLeastAxis * kLeastAxis), quat, scales);
  for (int k = 0; k < 3; ++k) scales[k] = sqrt(scales[k]);
}

// A Gaussian that rides: turned by the rotation as it is where the map hardly stretches, else
// covariance A S A^T by the axes of A R diag(s), which stretched(A R diag(s)) sees to.
template <typename T, typename Stretched>
GSF_HOST_DEVICE void carry_axes(const CarryAxesArgs<T>& a, int64_t i, const Stretched& stretched) {
  using std::abs;
  const T* s = a.rest_scales + 3 * i;
  T *quat = a.quats + 4 * i, *scales = a.scales + 3 * i;
  const Mat3<T> map = load_mat3(a.map + 9 * i), turn = load_mat3(a.rotation + 9 * i);
  Mat3<T> axes;
  if (!rotation_from_quat(a.rest_quats + 4 * i, &axes)) axes = identity3<T>();
  T change = T(0);
  for (int k = 0; k < 9; ++k) change = max(change, abs(map.m[k] - turn.m[k]));
  Mat3<T> root = matmul(map, axes);
  for (int r = 0; r < 3; ++r)
    for (int c = 0; c < 3; ++c) root(r, c) *= s[c];
  if (change > a.rigid && finite(root)) {
    stretched(root);
    return;
  }
  const Mat3<T> turned = matmul(turn, axes);
  quat_from_rotation(finite(turned) ? turned : axes, quat);
  for (int k = 0; k < 3; ++k) scales[k] = s[k];
}
template <typename T>
GSF_HOST_DEVICE void carry_axes(const CarryAxesArgs<T>& a, int64_t i) {
  carry_axes(a, i, [&](const Mat3<T>& root) {
    ellipsoid_axes(root, T(kLeastAxis), a.quats + 4 * i, a.scales + 3 * i);
  });
}

// Where a place at rest has gone: with the neighbours of its point that have not parted, each by
// its own map, by a Gaussian of the distance at rest. A number that is no point moves nothing.
template <typename T>
GSF_HOST_DEVICE void carry_place(const CarryPlaceArgs<T>& a, int64_t i) {
  using std::exp;
  const T* p = a.places + 3 * i;
  const int64_t own = a.owner[i];
  Vec3<T> mean{T(0), T(0), T(0)};
  Mat3<T> blend{};
  T total = T(0);
  if (own >= 0 && own < a.points) {
    const T narrow = T(-0.5) / (a.width[own] * a.width[own]);
    for (int k = 0; k < a.near_count; ++k) {
      const int64_t j = a.near[own * a.near_count + k];
      if (a.parted[own * a.near_count + k] || j < 0 || j >= a.points) continue;
      const T* r = a.rest + 3 * j;
      const Vec3<T> arm{p[0] - r[0], p[1] - r[1], p[2] - r[2]};
      // Far from all points (a stray) the nearest ones still carry it.
      const T w = max(exp(narrow * dot(arm, arm)), T(1e-12));
      const Mat3<T> map = load_mat3(a.map + 9 * j);
      const T* x = a.position + 3 * j;
      mean = mean + w * (Vec3<T>{x[0], x[1], x[2]} + matvec(map, arm));
      for (int c = 0; c < 9; ++c) blend.m[c] += w * map.m[c];
      total += w;
    }
  }
  const bool moved = total > T(0);
  const T share = moved ? T(1) / total : T(0);
  for (int c = 0; c < 3; ++c) a.means[3 * i + c] = moved ? share * mean[c] : p[c];
  for (int c = 0; c < 9; ++c) a.blend[9 * i + c] = moved ? share * blend.m[c] : T(c % 4 == 0);
}

}  // namespace gsf
