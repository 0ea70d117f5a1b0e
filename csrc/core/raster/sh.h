// Real spherical harmonics up to degree 3 in the basis order and signs of 3D Gaussian splatting
// (Y1 = -y, z, -x), with the gradient with respect to the direction. Templated on the scalar; no
// memory, no torch.
#pragma once

#include "core/vec.h"

namespace gsf {

constexpr int kMaxShCoefficients = 16;

GSF_HOST_DEVICE constexpr int sh_coefficients(int degree) { return (degree + 1) * (degree + 1); }

// basis[k] = Y_k(direction) for the (degree + 1)^2 functions; `d` must be of unit length.
template <typename T>
GSF_HOST_DEVICE void sh_basis(int degree, const Vec3<T>& d, T* basis) {
  basis[0] = T(0.28209479177387814);
  if (degree < 1) return;
  const T x = d.x, y = d.y, z = d.z;
  const T c1 = T(0.4886025119029199);
  basis[1] = -c1 * y;
  basis[2] = c1 * z;
  basis[3] = -c1 * x;
  if (degree < 2) return;
  const T xx = x * x, yy = y * y, zz = z * z;
  const T c2 = T(1.0925484305920792);
  basis[4] = c2 * x * y;
  basis[5] = -c2 * y * z;
  basis[6] = T(0.31539156525252005) * (2 * zz - xx - yy);
  basis[7] = -c2 * x * z;
  basis[8] = T(0.5462742152960396) * (xx - yy);
  if (degree < 3) return;
  const T c3 = T(0.4570457994644658), c4 = T(0.5900435899266435);
  basis[9] = -c4 * y * (3 * xx - yy);
  basis[10] = T(2.890611442640554) * x * y * z;
  basis[11] = -c3 * y * (4 * zz - xx - yy);
  basis[12] = T(0.3731763325901154) * z * (2 * zz - 3 * xx - 3 * yy);
  basis[13] = -c3 * x * (4 * zz - xx - yy);
  basis[14] = T(1.445305721320277) * z * (xx - yy);
  basis[15] = -c4 * x * (xx - 3 * yy);
}

// Gradient with respect to the (unit) direction of sum_k weight[k] Y_k(direction), where the Y_k
// are taken as the polynomials above; the caller projects it through the normalisation.
template <typename T>
GSF_HOST_DEVICE Vec3<T> sh_basis_gradient(int degree, const Vec3<T>& d, const T* weight) {
  Vec3<T> g{T(0), T(0), T(0)};
  if (degree < 1) return g;
  const T x = d.x, y = d.y, z = d.z;
  const T c1 = T(0.4886025119029199);
  g.x -= c1 * weight[3];
  g.y -= c1 * weight[1];
  g.z += c1 * weight[2];
  if (degree < 2) return g;
  const T xx = x * x, yy = y * y, zz = z * z;
  const T c2 = T(1.0925484305920792), c20 = T(0.31539156525252005), c22 = T(0.5462742152960396);
  g.x += c2 * (y * weight[4] - z * weight[7]) + 2 * x * (c22 * weight[8] - c20 * weight[6]);
  g.y += c2 * (x * weight[4] - z * weight[5]) - 2 * y * (c22 * weight[8] + c20 * weight[6]);
  g.z += -c2 * (y * weight[5] + x * weight[7]) + 4 * c20 * z * weight[6];
  if (degree < 3) return g;
  const T c3 = T(0.4570457994644658), c4 = T(0.5900435899266435), c5 = T(2.890611442640554);
  const T c6 = T(0.3731763325901154), c7 = T(1.445305721320277);
  g.x += -6 * c4 * x * y * weight[9] + c5 * y * z * weight[10] + 2 * c3 * x * y * weight[11] -
         6 * c6 * x * z * weight[12] - c3 * (4 * zz - 3 * xx - yy) * weight[13] +
         2 * c7 * x * z * weight[14] - 3 * c4 * (xx - yy) * weight[15];
  g.y += -3 * c4 * (xx - yy) * weight[9] + c5 * x * z * weight[10] -
         c3 * (4 * zz - xx - 3 * yy) * weight[11] - 6 * c6 * y * z * weight[12] +
         2 * c3 * x * y * weight[13] - 2 * c7 * y * z * weight[14] + 6 * c4 * x * y * weight[15];
  g.z += c5 * x * y * weight[10] - 8 * c3 * y * z * weight[11] +
         c6 * (6 * zz - 3 * xx - 3 * yy) * weight[12] - 8 * c3 * x * z * weight[13] +
         c7 * (xx - yy) * weight[14];
  return g;
}

}  // namespace gsf
