// Occupancy of space by splats on one dense grid with a pyramid of coarser levels, and outward
// normals from its gradient. The model, with every formula: gsfluent/ops/reference/density.py.
// Cells are numbered z, y, x; values stand at cell centres and are zero outside the grid.
#pragma once

#include "core/raster/order_free.h"
#include "core/raster/splat.h"

namespace gsf {

constexpr int kDensityLevels = 5;  // each with cells twice as wide as the one before
constexpr int kDensityWide = 2;    // level whose gradient settles which side is out
constexpr int kDensityPasses = 4;  // of [1, 2, 1] / 4 over the finest level, one over the wide one
constexpr double kDensityClear = 0.1;  // how sure the wide gradient must be
// Half the gradient up to which a sheet does not say which way its splats lie.
constexpr double kDensityUnclear = 0.05;
// Gradient from which the density leads, and the share of a flat splat's own axis then.
constexpr double kDensitySure = 0.12;
constexpr double kDensityOwn = 0.5;
constexpr double kDensityAway = -0.25;
constexpr double kFlatSplat = 0.5;  // shortest over middle axis

template <typename T>
struct DensityArgs {
  int64_t count;   // N
  const T* means;  // [N, 3]
  const T* frame;  // [4] corner and finest cell
  int nodes;       // cells along the finest level's side
  T full;          // splats in a cell that counts as full
  T* values;       // all levels, the finest first
  int64_t* units;  // [nodes^3] zeros, for sums without an order (CUDA)

  // Whole numbers that a weight of one is worth: `count` of them fit.
  GSF_HOST_DEVICE double per_weight() const {
    return double(int64_t(1) << (62 - bits_above(count)));
  }
};

template <typename T>
struct DensityNormalArgs {
  int64_t count;
  const T *means, *quats, *scales;  // [N, 3], [N, 4], [N, 3]
  const T* values;                  // of DensityArgs
  const T* frame;
  const T* eye;  // [3], what flat splats face, or null
  int nodes;
  T *fine, *wide;  // smoothed levels 0 and kDensityWide
  T* spare;        // as large as `fine`
  T* normals;      // [N, 3]
};

template <typename T>
struct BulkArgs {
  int64_t count;
  const T *means, *scales;  // [N, 3] each
  double* out;              // [kBulkSize]
  double* shares;           // [kBulkShares, kBulkSums], for sums in one order (CUDA)
};
constexpr int kBulkShares = 512;  // blocks at most

// Sums of a cloud of splats over those with finite numbers: how many, centre, squared distance from
// the origin of the coordinates, the three scales. What comes out: centre x, y, z, root mean square
// and largest distance from it, mean scale.
constexpr int kBulkSums = 6;
constexpr int kBulkSize = 6;
template <typename T>
GSF_HOST_DEVICE bool bulk_terms(const BulkArgs<T>& a, int64_t i, double* sum) {
  const double x = a.means[3 * i], y = a.means[3 * i + 1], z = a.means[3 * i + 2];
  const double size = double(a.scales[3 * i]) + a.scales[3 * i + 1] + a.scales[3 * i + 2];
  if (!finite(x + y + z + size)) return false;
  sum[0] += 1.0;
  sum[1] += x;
  sum[2] += y;
  sum[3] += z;
  sum[4] += x * x + y * y + z * z;
  sum[5] += size;
  return true;
}
// `sum` may be `out`; the largest distance is left at zero.
GSF_HOST_DEVICE void bulk_finish(const double* sum, double* out) {
  const double n = max(sum[0], 1.0), x = sum[1] / n, y = sum[2] / n, z = sum[3] / n;
  const double spread = max(sum[4] / n - (x * x + y * y + z * z), 0.0), size = sum[5] / (3.0 * n);
  out[0] = x;
  out[1] = y;
  out[2] = z;
  out[3] = std::sqrt(spread);
  out[4] = 0.0;
  out[5] = size;
}
// Squared distance of splat `i` from the centre, 0 when it was left out.
template <typename T>
GSF_HOST_DEVICE double bulk_away(const BulkArgs<T>& a, int64_t i) {
  double unused[kBulkSums];
  for (double& v : unused) v = 0.0;
  if (!bulk_terms(a, i, unused)) return 0.0;
  const double x = a.means[3 * i] - a.out[0], y = a.means[3 * i + 1] - a.out[1],
               z = a.means[3 * i + 2] - a.out[2];
  return x * x + y * y + z * z;
}

GSF_HOST_DEVICE int64_t density_level(int nodes, int level) {
  int64_t start = 0;
  for (int l = 0; l < level; ++l) {
    const int64_t side = nodes >> l;
    start += side * side * side;
  }
  return start;
}

// The eight cells around a point, and its place among them; false when one is off the grid.
template <typename T>
struct DensityPlace {
  int64_t first;
  int x, y, z;
  T fx, fy, fz;

  GSF_HOST_DEVICE bool of(const T* frame, int nodes, const T* p) {
    using std::floor;
    const T px = (p[0] - frame[0]) / frame[3] - T(0.5);
    const T py = (p[1] - frame[1]) / frame[3] - T(0.5);
    const T pz = (p[2] - frame[2]) / frame[3] - T(0.5);
    const T x0 = floor(px), y0 = floor(py), z0 = floor(pz), most = T(nodes - 1);
    // Written so that NaN fails.
    if (!(x0 >= T(0) && x0 < most && y0 >= T(0) && y0 < most && z0 >= T(0) && z0 < most))
      return false;
    x = static_cast<int>(x0);
    y = static_cast<int>(y0);
    z = static_cast<int>(z0);
    fx = px - x0;
    fy = py - y0;
    fz = pz - z0;
    first = (int64_t(z) * nodes + y) * nodes + x;
    return true;
  }
  GSF_HOST_DEVICE T weight(int corner) const {
    return (corner & 1 ? fx : T(1) - fx) * (corner >> 1 & 1 ? fy : T(1) - fy) *
           (corner >> 2 ? fz : T(1) - fz);
  }
  GSF_HOST_DEVICE int64_t cell(int corner, int nodes) const {
    return first + (int64_t(corner >> 2) * nodes + (corner >> 1 & 1)) * nodes + (corner & 1);
  }
};

// Weight of the cell `offset` away in `passes` passes of [1, 2, 1] / 4: binomial over 4^passes.
template <typename T>
GSF_HOST_DEVICE T binomial_weight(int passes, int offset) {
  T w = T(1);
  for (int k = 0; k < passes + offset; ++k) w = w * T(2 * passes - k) / T(k + 1);
  for (int k = 0; k < passes; ++k) w *= T(0.25);
  return w;
}

// Trilinear gradient per cell, times -1, of one level at a point; 0 off the grid.
template <typename T>
GSF_HOST_DEVICE Vec3<T> density_gradient(const T* v, int side, T cell, const T* frame, const T* p) {
  using std::floor;
  const Vec3<T> place{(p[0] - frame[0]) / cell - T(0.5), (p[1] - frame[1]) / cell - T(0.5),
                      (p[2] - frame[2]) / cell - T(0.5)};
  const T x0 = floor(place.x), y0 = floor(place.y), z0 = floor(place.z), high = T(side);
  Vec3<T> sum{T(0), T(0), T(0)};
  if (!(x0 >= T(-1) && x0 < high && y0 >= T(-1) && y0 < high && z0 >= T(-1) && z0 < high))
    return sum;
  const int i = static_cast<int>(x0), j = static_cast<int>(y0), k = static_cast<int>(z0);
  const T fx = place.x - x0, fy = place.y - y0, fz = place.z - z0;
  const auto at = [&](int x, int y, int z) {
    const bool inside = x >= 0 && x < side && y >= 0 && y < side && z >= 0 && z < side;
    return inside ? v[(int64_t(z) * side + y) * side + x] : T(0);
  };
  for (int corner = 0; corner < 8; ++corner) {
    const int dx = corner & 1, dy = corner >> 1 & 1, dz = corner >> 2;
    const int x = i + dx, y = j + dy, z = k + dz;
    if (x < 0 || x >= side || y < 0 || y >= side || z < 0 || z >= side) continue;
    const T w = T(0.5) * (dx ? fx : T(1) - fx) * (dy ? fy : T(1) - fy) * (dz ? fz : T(1) - fz);
    sum.x += w * (at(x - 1, y, z) - at(x + 1, y, z));
    sum.y += w * (at(x, y - 1, z) - at(x, y + 1, z));
    sum.z += w * (at(x, y, z - 1) - at(x, y, z + 1));
  }
  return sum;
}

// Outward vector of splat `i`; its length, up to one, says how sure it is.
template <typename T>
GSF_HOST_DEVICE void density_normal(const DensityNormalArgs<T>& a, int64_t i) {
  using std::fabs;
  const T* p = a.means + 3 * i;
  const T cell = a.frame[3];
  Vec3<T> out = density_gradient(a.fine, a.nodes, cell, a.frame, p);
  const Vec3<T> wide =
      density_gradient(a.wide, a.nodes >> kDensityWide, cell * T(1 << kDensityWide), a.frame, p);
  // A skin with a gap below it is a sheet to the fine grid, and a sheet has no inside.
  if (dot(out, wide) < T(0) && norm(wide) > T(kDensityClear)) out = T(-1) * out;
  const T *s = a.scales + 3 * i, shortest = min(s[0], min(s[1], s[2]));
  const T middle = s[0] + s[1] + s[2] - shortest - max(s[0], max(s[1], s[2]));
  Mat3<T> axes;
  if (shortest < T(kFlatSplat) * middle && rotation_from_quat(a.quats + 4 * i, &axes)) {
    // Which column, without an index that changes: that would put the matrix into local memory.
    const bool first = s[0] == shortest, second = !first && s[1] == shortest;
    const Vec3<T> axis = matvec(axes, Vec3<T>{T(first), T(second), T(!first && !second)});
    const T agreement = dot(axis, out), clear = norm(out), side = T(agreement < T(0) ? -1 : 1);
    if (clear > T(kDensitySure)) {
      // A solid's density knows better than one splat; their sum keeps what both say.
      const Vec3<T> sum = (T(1) / clear) * out + (T(kDensityOwn) * side) * axis;
      out = (T(1) / norm(sum)) * sum;
    } else if (fabs(agreement) > T(0.5) * clear - T(kDensityUnclear)) {
      // Across a clear gradient it would be a splat standing on edge (hair, seams).
      out = side * axis;
    }
  }
  if (a.eye) {
    const Vec3<T> view{a.eye[0] - p[0], a.eye[1] - p[1], a.eye[2] - p[2]};
    // Seen edge on, the eye tells no side, and another one for every splat. Nor does it of what
    // both gradients are sure of: that sticks out over an outline, and turned it would be in the
    // dark.
    const bool sure =
        dot(out, wide) > T(0) && norm(wide) > T(kDensityClear) && norm(out) > T(kDensitySure);
    if (!sure && dot(out, view) < T(kDensityAway) * norm(out) * norm(view)) out = T(-1) * out;
  }
  for (int c = 0; c < 3; ++c) a.normals[3 * i + c] = out[c];
}

}  // namespace gsf
