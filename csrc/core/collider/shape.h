// One rigid collider as a row of numbers, and its signed distance. No torch, no loops over nodes.
// A row is all that a kernel knows of a collider; x is any coordinate the row's point is given in.
#pragma once

#include "core/vec.h"

namespace gsf {

enum ColliderColumn {
  kType = 0,              // ColliderType
  kMode = 1,              // 0 sticky, 1 slip, 2 separate
  kFriction = 2,          // Coulomb coefficient (separate only)
  kPoint = 3,             // plane point, centre of the shape: the point it turns about [m]
  kNormal = 6,            // plane normal, out of the collider; need not be of unit length
  kCorner = 6,            // distance grid: position of its first value in the body frame [m]
  kRadius = 9,            // sphere, capsule, cylinder [m]; plane: 0 endless, else that of its disc
  kSpacing = 9,           // distance grid: distance between values [m]
  kVelocity = 10,         // of the point [m/s]
  kRestitution = 13,      // of a separating collider, 0 to 1
  kMass = 14,             // 0: moves as told; > 0: takes the impulse of what it hits [kg]
  kSweep = 15,            // not 0: also what it meets on its way during the step is hit
  kOrientation = 16,      // quaternion w, x, y, z, body to world; all 0 is no turn
  kAngularVelocity = 20,  // [rad/s]
  kInertia = 23,          // principal moments in the body frame [kg m^2]; 0: no turning by impulse
  kExtent = 26,           // box: half edges; capsule, cylinder: half length in z (third) [m];
                          // distance grid: number of values along x, y, z
  kSdfStart = 29,         // distance grid: its first value in the buffer, in units of 64 values
  kOnlyCut = 30,          // 0: acts on all matter; n > 0: only on fields whose `cut` has bit n - 1
  kStiffer = 31           // springs that push points are 1 + this times as stiff as their matter
};
constexpr int kColliderColumns = 32;
constexpr int64_t kSdfAlign = 64;  // so that offsets are exact in float32 up to 2^30

enum ColliderType {
  kNothing = -1,  // an empty row
  kPlane = 0,     // the half space behind the plane, or the round bar behind its disc
  kSphere = 1,
  kBox = 2,
  kCapsule = 3,   // axis along z of the body frame
  kCylinder = 4,  // axis along z of the body frame
  kSdf = 5,       // signed distances at the nodes of a grid, z fastest
  kFace = 6       // half space under a rectangle in the plane z = 0 of the body frame, as deep as
                  // the third half edge; it holds nothing beyond its rim: a blade's face
};

// v turned by the quaternion q (any length but 0; the zero quaternion turns nothing), or back.
template <typename T>
GSF_HOST_DEVICE Vec3<T> turn(const T* q, const Vec3<T>& v, bool back = false) {
  const T squared = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
  if (!(squared > T(0))) return v;
  const Vec3<T> axis{q[1], q[2], q[3]};
  const Vec3<T> c = cross(axis, v);
  return v + (T(2) / squared) * ((back ? -q[0] : q[0]) * c + cross(axis, c));
}

// Distance and normal of the rounded corner between a face at height h (direction `up`) and a side
// at distance q (direction `out`): both <= 0 is inside.
template <typename T>
GSF_HOST_DEVICE T corner_distance(T h, const Vec3<T>& up, T q, const Vec3<T>& out,
                                  Vec3<T>& normal) {
  if (h <= T(0) || q <= T(0)) {
    normal = h >= q ? up : out;
    return max(h, q);
  }
  using std::sqrt;
  const T d = sqrt(h * h + q * q);
  normal = (h / d) * up + (q / d) * out;
  return d;
}

// p / |p|, or `fallback` where p has no direction.
template <typename T>
GSF_HOST_DEVICE Vec3<T> direction(const Vec3<T>& p, T length, const Vec3<T>& fallback) {
  return length > T(0) ? (T(1) / length) * p : fallback;
}

template <typename T>
GSF_HOST_DEVICE T box_distance(const Vec3<T>& p, const T* half, Vec3<T>& normal) {
  T inside = T(-INFINITY), outside = T(0);
  Vec3<T> nearest{T(0), T(0), T(1)}, out{T(0), T(0), T(0)};
  for (int i = 0; i < 3; ++i) {
    const T side = p[i] < T(0) ? T(-1) : T(1);
    const T q = side * p[i] - half[i];
    if (q > inside) {
      inside = q;
      nearest = {T(0), T(0), T(0)};
      nearest[i] = side;
    }
    if (q > T(0)) {
      out[i] = side * q;
      outside += q * q;
    }
  }
  if (outside > T(0)) {
    using std::sqrt;
    outside = sqrt(outside);
    normal = (T(1) / outside) * out;
    return outside;
  }
  normal = nearest;
  return inside;
}

// Trilinear distance and its gradient at p in the body frame. Outside the grid a lower bound of the
// distance: safe for walking along a ray.
template <typename T>
GSF_HOST_DEVICE T sdf_distance(const T* row, const float* sdf, const Vec3<T>& p, Vec3<T>& normal) {
  using std::floor;
  int64_t size[3], base[3];
  T f[3];
  Vec3<T> beyond;
  const T h = row[kSpacing];
  for (int i = 0; i < 3; ++i) {
    size[i] = static_cast<int64_t>(row[kExtent + i]);
    const T u = (p[i] - row[kCorner + i]) / h;
    const T inside = clamp(u, T(0), T(size[i] - 1));
    if (!finite(u)) return T(NAN);  // the index below must never be made of NaN
    beyond[i] = (u - inside) * h;
    base[i] = min(static_cast<int64_t>(floor(inside)), size[i] - 2);
    f[i] = inside - T(base[i]);
  }
  const float* at = sdf + kSdfAlign * static_cast<int64_t>(row[kSdfStart]) +
                    (base[0] * size[1] + base[1]) * size[2] + base[2];
  T value = T(0);
  Vec3<T> slope{T(0), T(0), T(0)};
  for (int i = 0; i < 2; ++i)
    for (int j = 0; j < 2; ++j)
      for (int k = 0; k < 2; ++k) {
        const T v = T(at[(i * size[1] + j) * size[2] + k]);
        const T wx = i ? f[0] : T(1) - f[0], wy = j ? f[1] : T(1) - f[1],
                wz = k ? f[2] : T(1) - f[2];
        value += wx * wy * wz * v;
        slope =
            slope + Vec3<T>{(i ? v : -v) * wy * wz, wx * (j ? v : -v) * wz, wx * wy * (k ? v : -v)};
      }
  const T gap = norm(beyond);
  if (gap > T(0)) {
    normal = (T(1) / gap) * beyond;
    return max(gap, value - gap);
  }
  normal = direction(slope, norm(slope), Vec3<T>{T(0), T(0), T(1)});
  return value;
}

// Whether a row describes a collider that can be computed with; `sdf_count` values of distance
// grids exist. Every column is finite, so distances at finite x are too.
template <typename T>
GSF_HOST_DEVICE bool collider_valid(const T* row, int64_t sdf_count) {
  for (int i = 0; i < kColliderColumns; ++i)
    if (!finite(row[i])) return false;
  const T type = row[kType], mode = row[kMode];
  if (type == T(kNothing)) return true;
  if (!(mode == T(0) || mode == T(1) || mode == T(2))) return false;
  if (!(row[kFriction] >= T(0) && row[kMass] >= T(0) && row[kRadius] >= T(0))) return false;
  if (!(row[kRestitution] >= T(0) && row[kRestitution] <= T(1))) return false;
  if (!(row[kStiffer] >= T(0) && row[kStiffer] <= T(3))) return false;
  for (int i = 0; i < 3; ++i)
    if (!(row[kInertia + i] >= T(0) && row[kExtent + i] >= T(0))) return false;
  const T *e = row + kExtent, r = row[kRadius];
  if (type == T(kPlane)) return norm(load_vec3(row + kNormal)) > T(0) && row[kMass] == T(0);
  if (type == T(kSphere)) return r > T(0);
  if (!(row[kOnlyCut] >= T(0) && row[kOnlyCut] <= T(30))) return false;
  if (type == T(kBox) || type == T(kFace)) return e[0] > T(0) && e[1] > T(0) && e[2] > T(0);
  if (type == T(kCapsule)) return r > T(0);
  if (type == T(kCylinder)) return r > T(0) && e[2] > T(0);
  if (type != T(kSdf) || !(r > T(0)) || !(row[kSdfStart] >= T(0))) return false;
  double values = 1.0;
  for (int i = 0; i < 3; ++i) {
    // A float that is no whole number would be cut down below: refuse it instead.
    if (!(e[i] >= T(2) && e[i] <= T(4096) && e[i] == T(static_cast<int64_t>(e[i])))) return false;
    values *= double(e[i]);
  }
  return double(kSdfAlign) * double(row[kSdfStart]) + values <= double(sdf_count) &&
         row[kSdfStart] == T(static_cast<int64_t>(row[kSdfStart]));
}

// Signed distance [m] of x from a valid collider, negative inside, and the unit normal out of it.
template <typename T>
GSF_HOST_DEVICE T collider_signed_distance(const T* row, const float* sdf, const Vec3<T>& x,
                                           Vec3<T>& normal) {
  const int type = static_cast<int>(row[kType]);
  normal = {T(0), T(0), T(1)};
  if (type == kNothing) return T(INFINITY);
  const Vec3<T> p = turn(row + kOrientation, x - load_vec3(row + kPoint), true);
  const T r = row[kRadius];
  T d = T(INFINITY);
  Vec3<T> n = normal;
  if (type == kSphere) {
    const T length = norm(p);
    n = direction(p, length, n);
    d = length - r;
  } else if (type == kPlane) {
    const Vec3<T> given = load_vec3(row + kNormal);
    n = (T(1) / norm(given)) * given;
    d = dot(p, n);
    if (r > T(0)) {
      const Vec3<T> side = p - d * n, up = n;
      const T length = norm(side);
      d = corner_distance(d, up, length - r, direction(side, length, up), n);
    }
  } else if (type == kBox) {
    d = box_distance(p, row + kExtent, n);
  } else if (type == kCapsule) {
    const T half = row[kExtent + 2];
    const Vec3<T> side{p.x, p.y, p.z - clamp(p.z, -half, half)};
    const T length = norm(side);
    n = direction(side, length, Vec3<T>{T(1), T(0), T(0)});
    d = length - r;
  } else if (type == kCylinder) {
    const T up = p.z < T(0) ? T(-1) : T(1);
    const Vec3<T> side{p.x, p.y, T(0)};
    const T length = norm(side);
    d = corner_distance(up * p.z - row[kExtent + 2], Vec3<T>{T(0), T(0), up}, length - r,
                        direction(side, length, Vec3<T>{T(1), T(0), T(0)}), n);
  } else if (type == kFace) {
    const T* e = row + kExtent;
    if (p.x >= -e[0] && p.x <= e[0] && p.y >= -e[1] && p.y <= e[1] && p.z >= -e[2]) d = p.z;
  } else if (type == kSdf) {
    d = sdf_distance(row, sdf, p, n);
  }
  normal = turn(row + kOrientation, n);
  return d;
}

// Lower bound of the distance from x to all that a valid collider holds: its signed distance; of a
// face, which holds nothing beyond its rim, the distance of a box about what is under it.
template <typename T>
GSF_HOST_DEVICE T collider_clearance(const T* row, const float* sdf, const Vec3<T>& x) {
  Vec3<T> normal;
  if (row[kType] != T(kFace)) return collider_signed_distance(row, sdf, x, normal);
  const Vec3<T> p = turn(row + kOrientation, x - load_vec3(row + kPoint), true);
  return box_distance(p, row + kExtent, normal);
}

// Radius of a ball about the collider's point that holds all of it [m]; infinite for a plane.
template <typename T>
GSF_HOST_DEVICE T collider_bound(const T* row) {
  using std::sqrt;
  const int type = static_cast<int>(row[kType]);
  const T r = row[kRadius], z = row[kExtent + 2];
  if (type == kNothing) return T(0);
  if (type == kSphere) return r;
  if (type == kBox || type == kFace) return norm(load_vec3(row + kExtent));
  if (type == kCapsule) return r + z;
  if (type == kCylinder) return sqrt(r * r + z * z);
  if (type != kSdf) return T(INFINITY);
  Vec3<T> far;
  for (int i = 0; i < 3; ++i) {
    const T low = row[kCorner + i], high = low + (row[kExtent + i] - T(1)) * row[kSpacing];
    far[i] = max(-low, high);
  }
  return norm(far);
}

}  // namespace gsf
