// One plain struct per collider kernel: pointers, sizes, and the work of one thread.
#pragma once

#include "core/collider/blade.h"
#include "core/collider/collider.h"

namespace gsf {

template <typename T>
struct ColliderDistanceArgs {
  const T* position;   // [points, 3] m
  const T* colliders;  // [rows, kColliderColumns]
  const float* sdf;    // [sdf_count] or null
  int64_t points, rows, sdf_count;
  T* distance;  // [points, rows] m
  T* normal;    // [points, rows, 3]

  // One point and one collider; NaN from a row that is no collider or a point that is not finite.
  GSF_HOST_DEVICE void compute(int64_t i) const {
    const T* row = colliders + (i % rows) * kColliderColumns;
    const Vec3<T> x = load_vec3(position + 3 * (i / rows));
    Vec3<T> n{T(NAN), T(NAN), T(NAN)};
    T d = T(NAN);
    if (collider_valid(row, sdf_count) && finite(x.x) && finite(x.y) && finite(x.z))
      d = collider_signed_distance(row, sdf, x, n);
    distance[i] = d;
    for (int k = 0; k < 3; ++k) normal[3 * i + k] = n[k];
  }
};

template <typename T>
struct AdvanceCollidersArgs {
  T* colliders;           // [rows, kColliderColumns], changed in place
  const double* impulse;  // [rows, 6] impulse and torque given to the bodies
  int64_t rows;
  double dt, gravity[3];

  GSF_HOST_DEVICE void compute(int64_t c) const {
    double row[kColliderColumns];
    T* kept = colliders + c * kColliderColumns;
    for (int i = 0; i < kColliderColumns; ++i) row[i] = double(kept[i]);
    advance_collider(row, dt, load_vec3(impulse + 6 * c), load_vec3(impulse + 6 * c + 3),
                     load_vec3(gravity));
    for (int i = 0; i < kColliderColumns; ++i) kept[i] = T(row[i]);
  }
};

template <typename T>
struct BladeSidesArgs {
  const T* position;   // [points, 3] m
  const T* blades;     // [rows, kBladeColumns], legs of one blade in a row
  const int32_t* cut;  // [points]
  int64_t points, rows;
  T reach;       // m
  int32_t* out;  // [points]

  GSF_HOST_DEVICE void compute(int64_t i) const {
    out[i] = blade_cut(blades, rows, load_vec3(position + 3 * i), reach, cut[i]);
  }
};

}  // namespace gsf
