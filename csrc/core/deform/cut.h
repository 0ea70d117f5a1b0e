// Gaussians cut at planes: what a crack leaves on its side of a splat that lay across it.
//
// Half a Gaussian is no Gaussian, but it has a mean and a variance. With t the distance of the
// plane from the centre in standard deviations and h = phi(t) / Phi(t) of the normal distribution,
// the part below has its mean h deviations further in and the variance 1 - t h - h^2 across the
// plane; along it nothing changes.
#pragma once

#include "core/deform/args.h"
#include "core/deform/carry.h"

namespace gsf {

constexpr double kCutReach = 2.0;    // planes further off than so many deviations cut nothing
constexpr double kCutBeyond = -1.5;  // planes that left less than so many deviations cut no further
constexpr double kCutCorner = 0.5;   // deviations by which a cut may lie in a third point's cell

// The part below a plane at `distance` along a unit normal, as mean and covariance.
template <typename T>
GSF_HOST_DEVICE void cut_gaussian(const Vec3<T>& normal, T distance, Vec3<T>& mean,
                                  Mat3<T>& covariance) {
  using std::erfc;
  using std::exp;
  using std::sqrt;
  const Vec3<T> along = matvec(covariance, normal);
  const T sigma = sqrt(max(dot(along, normal), T(1e-30)));
  const T t = max(distance / sigma, T(kCutBeyond));
  const T density = T(0.3989422804014327) * exp(T(-0.5) * t * t);
  if (!(density > T(0))) return;  // no plane, or one out of sight
  const T h = density / (T(0.5) * erfc(T(-0.7071067811865476) * t));
  const Vec3<T> step = (T(1) / sigma) * along;
  const T less = t * h + h * h;
  for (int r = 0; r < 3; ++r)
    for (int c = 0; c < 3; ++c) covariance(r, c) -= less * step[r] * step[c];
  mean = mean - h * step;
}

template <typename T>
GSF_HOST_DEVICE void store_gaussian(const Vec3<T>& mean, const Mat3<T>& covariance, T* at, T* quats,
                                    T* scales) {
  const Sym3<T> packed{covariance(0, 0), covariance(1, 1), covariance(2, 2),
                       covariance(0, 1), covariance(0, 2), covariance(1, 2)};
  T row[6];
  store_sym3(row, packed);
  covariance_axes(CovarianceAxesArgs<T>{1, row, quats, scales}, 0);
  store_vec3(at, mean);
}

// Splat i, cut where its own point's cell borders on the cells of points that moved away.
template <typename T>
GSF_HOST_DEVICE void cut_at_cells(const CutAtCellsArgs<T>& a, int64_t i) {
  using std::sqrt;
  const T *s = a.scales + 3 * i, *q = a.quats + 4 * i;
  const Vec3<T> center = load_vec3(a.means + 3 * i);
  const int64_t own = a.owner[i];
  Vec3<T> mean = center;
  Mat3<T> root, covariance{};
  bool any = false;
  if (own >= 0 && own < a.points) {
    const int64_t* near = a.near + own * a.near_count;
    if (!rotation_from_quat(q, &root)) root = identity3<T>();
    for (int r = 0; r < 3; ++r)
      for (int c = 0; c < 3; ++c) root(r, c) *= s[c];
    covariance = matmul(root, transpose(root));
    const Vec3<T> home = load_vec3(a.rest + 3 * own);
    const Vec3<T> out = home - center;
    for (int k = 0; k < a.near_count; ++k) {
      const int64_t j = near[k];
      if (!a.opened[own * a.near_count + k] || j < 0 || j >= a.points) continue;
      const Vec3<T> point = load_vec3(a.rest + 3 * j), across = point - home;
      const T width = norm(across);
      if (!(width > T(0))) continue;
      const Vec3<T> normal = (T(1) / max(width, T(1e-12))) * across;
      const Vec3<T> other = point - center;
      const T halfway = (dot(other, other) - dot(out, out)) / (T(2) * max(width, T(1e-12)));
      const T sigma = norm(matvec(transpose(root), normal));
      if (!(halfway < T(kCutReach) * sigma)) continue;
      // The face must be there: not where a third point's cell begins.
      const Vec3<T> spot = center + halfway * normal;
      const T least = norm(home - spot) - T(kCutCorner) * sigma;
      bool there = true;
      for (int n = 0; n < a.near_count && there; ++n) {
        const int64_t third = near[n];
        if (third < 0 || third >= a.points) continue;
        there = norm(load_vec3(a.rest + 3 * third) - spot) >= least;
      }
      if (!there) continue;
      any = true;
      const T depth = sqrt(max(dot(matvec(covariance, normal), normal), T(0)));
      const Vec3<T> anchor = home + T(0.5) * across;
      cut_gaussian(normal, dot(anchor - mean, normal) + a.slack * depth, mean, covariance);
    }
  }
  a.cut[i] = any;
  if (any) {
    store_gaussian(mean, covariance, a.new_means + 3 * i, a.new_quats + 4 * i,
                   a.new_scales + 3 * i);
    return;
  }
  store_vec3(a.new_means + 3 * i, center);
  for (int k = 0; k < 4; ++k) a.new_quats[4 * i + k] = q[k];
  for (int k = 0; k < 3; ++k) a.new_scales[3 * i + k] = s[k];
}

// Gaussian i, cut by its planes one after another, each by a share.
template <typename T>
GSF_HOST_DEVICE void cut_by_planes(const CutByPlanesArgs<T>& a, int64_t i) {
  Vec3<T> mean = load_vec3(a.means + 3 * i);
  const Vec3<T> whole = load_vec3(a.whole + 3 * i);
  Mat3<T> covariance = to_mat3(load_sym3(a.covariance + 6 * i));
  const auto bounded = [&](int64_t e) { return e < 0 ? 0 : (e > a.planes ? a.planes : e); };
  const int64_t end = bounded(a.first[i + 1]);
  for (int64_t e = bounded(a.first[i]); e < end; ++e) {
    const Vec3<T> normal = load_vec3(a.normal + 3 * e);
    Vec3<T> cut = mean;
    Mat3<T> shrunk = covariance;
    cut_gaussian(normal, a.distance[e] - dot(mean - whole, normal), cut, shrunk);
    const T share = a.share[e];
    mean = mean + share * (cut - mean);
    for (int k = 0; k < 9; ++k) covariance.m[k] += share * (shrunk.m[k] - covariance.m[k]);
  }
  store_gaussian(mean, covariance, a.new_means + 3 * i, a.quats + 4 * i, a.scales + 3 * i);
}

}  // namespace gsf
