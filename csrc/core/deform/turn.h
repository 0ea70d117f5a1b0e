// Rotations as quaternions wxyz and as matrices. Sums and products in the order of
// gsfluent/geometry.py.
#pragma once

#include <limits>

#include "core/deform/args.h"
#include "core/deform/carry.h"

namespace gsf {

// The identity for a quaternion without direction or with one that is not a number.
template <typename T>
GSF_HOST_DEVICE void quats_to_matrices(const TurnArgs<T>& a, int64_t i) {
  using std::sqrt;
  const T* q = a.first + 4 * i;
  const T length = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  T w = T(1), x = T(0), y = T(0), z = T(0);
  if (length > std::numeric_limits<T>::min()) {
    w = q[0] / length;
    x = q[1] / length;
    y = q[2] / length;
    z = q[3] / length;
  }
  const Mat3<T> m = {{T(1) - T(2) * (y * y + z * z), T(2) * (x * y - w * z), T(2) * (x * z + w * y),
                      T(2) * (x * y + w * z), T(1) - T(2) * (x * x + z * z), T(2) * (y * z - w * x),
                      T(2) * (x * z - w * y), T(2) * (y * z + w * x),
                      T(1) - T(2) * (x * x + y * y)}};
  store_mat3(a.out + 9 * i, m);
}

template <typename T>
GSF_HOST_DEVICE void matrices_to_quats(const TurnArgs<T>& a, int64_t i) {
  quat_from_rotation(load_mat3(a.first + 9 * i), a.out + 4 * i);
}

// Hamilton product: first `second`, then `first`.
template <typename T>
GSF_HOST_DEVICE void quat_products(const TurnArgs<T>& a, int64_t i) {
  const T *l = a.first + 4 * i, *r = a.second + 4 * i;
  T* out = a.out + 4 * i;
  out[0] = l[0] * r[0] - l[1] * r[1] - l[2] * r[2] - l[3] * r[3];
  out[1] = l[0] * r[1] + l[1] * r[0] + l[2] * r[3] - l[3] * r[2];
  out[2] = l[0] * r[2] - l[1] * r[3] + l[2] * r[0] + l[3] * r[1];
  out[3] = l[0] * r[3] + l[1] * r[2] - l[2] * r[1] + l[3] * r[0];
}

}  // namespace gsf
