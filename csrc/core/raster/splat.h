// One Gaussian splat: projection to the screen (EWA), its extent, and the exact adjoint of both.
// Conventions: quaternion wxyz, view = world->camera with OpenCV axes, pixel centres at +0.5. Every
// value that must agree between CPU, CUDA and the PyTorch reference is a constant here.
// What is written without branches also takes packets of splats for T (csrc/cpu/raster/packet.h):
// a comparison of those is a mask.
#pragma once

#include "core/raster/sh.h"

namespace gsf {

template <typename T>
using Flag = decltype(T() < T());

// One of two values; cpu/pack.h has the same by lanes.
template <typename T>
GSF_HOST_DEVICE T select(bool where, T yes, T no) {
  return where ? yes : no;
}

constexpr double kScreenBlur = 0.3;        // low-pass added to both variances [px^2]
constexpr double kMinAlpha = 1.0 / 255.0;  // smaller contributions are skipped
// Cap; no gradient where it binds. A float in double too: two capped splats end a pixel either way.
constexpr double kMaxAlpha = 0.99f;
constexpr double kMinTransmittance = 1e-4;       // a pixel stops before going below
constexpr double kMaxPower = 0.5 * 3.33 * 3.33;  // support in half squared sigmas
constexpr double kMinCompensation = 0.005;       // floor of the antialiasing factor
constexpr double kFrustumMargin = 0.3;           // of tan(fov/2), beyond the image edges, for J
// Colours, normals and camera z beyond are not drawn: times a gradient they would leave float32.
constexpr double kMaxFeature = 1e15;
// Wider splats are not drawn: sums of squared distances [px^2] would leave float32 too.
constexpr double kMaxVariance = 1e18;
constexpr int kSiblingRing = 8;  // group ids remembered per pixel

// Pinhole camera as the kernels use it. `rotation`, `translation`: world->camera.
template <typename T>
struct SplatCamera {
  Mat3<T> rotation;
  Vec3<T> translation;
  Vec3<T> centre;  // camera position in the world
  T fx, fy, cx, cy;
  T low_u, high_u, low_v, high_v;  // clamp of x/z and y/z inside the Jacobian
  T near, far;
  int width, height;
};

// viewmat [4, 4] and intrinsics [3, 3], row-major.
template <typename T>
GSF_HOST_DEVICE SplatCamera<T> make_splat_camera(const T* viewmat, const T* intrinsics, int width,
                                                 int height, T near, T far) {
  SplatCamera<T> c;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) c.rotation(i, j) = viewmat[4 * i + j];
  c.translation = {viewmat[3], viewmat[7], viewmat[11]};
  c.centre = T(-1) * matvec(transpose(c.rotation), c.translation);
  c.fx = intrinsics[0];
  c.fy = intrinsics[4];
  c.cx = intrinsics[2];
  c.cy = intrinsics[5];
  const T margin_u = T(kFrustumMargin) * T(0.5) * T(width) / c.fx;
  const T margin_v = T(kFrustumMargin) * T(0.5) * T(height) / c.fy;
  c.low_u = -c.cx / c.fx - margin_u;
  c.high_u = (T(width) - c.cx) / c.fx + margin_u;
  c.low_v = -c.cy / c.fy - margin_v;
  c.high_v = (T(height) - c.cy) / c.fy + margin_v;
  c.near = near;
  c.far = min(far, T(kMaxFeature));
  c.width = width;
  c.height = height;
  return c;
}

// Columns of `axes` are the rotated unit axes; false for a quaternion without direction.
template <typename T>
GSF_HOST_DEVICE Flag<T> rotation_from_quat(const T* q, Mat3<T>* axes) {
  using std::sqrt;
  const T n2 = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
  const T s = T(1) / sqrt(n2), one = T(1), two = T(2);
  const T w = s * q[0], x = s * q[1], y = s * q[2], z = s * q[3];
  *axes = {{one - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y),
            two * (x * y + w * z), one - two * (x * x + z * z), two * (y * z - w * x),
            two * (x * z - w * y), two * (y * z + w * x), one - two * (x * x + y * y)}};
  return (n2 > T(1e-24)) & finite(n2);
}

// Adjoint of rotation_from_quat: gradient of the axes -> gradient of the raw quaternion, through
// the normalisation (so it is orthogonal to q).
template <typename T>
GSF_HOST_DEVICE void rotation_from_quat_backward(const T* q, const Mat3<T>& g, T* grad) {
  using std::sqrt;
  const T two = T(2);
  const T s = T(1) / sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  const T w = s * q[0], x = s * q[1], y = s * q[2], z = s * q[3];
  const T gw = two * (x * (g.m[7] - g.m[5]) + y * (g.m[2] - g.m[6]) + z * (g.m[3] - g.m[1]));
  const T gx = two * (y * (g.m[1] + g.m[3]) + z * (g.m[2] + g.m[6]) + w * (g.m[7] - g.m[5]) -
                      two * x * (g.m[4] + g.m[8]));
  const T gy = two * (x * (g.m[1] + g.m[3]) + z * (g.m[5] + g.m[7]) + w * (g.m[2] - g.m[6]) -
                      two * y * (g.m[0] + g.m[8]));
  const T gz = two * (x * (g.m[2] + g.m[6]) + y * (g.m[5] + g.m[7]) + w * (g.m[3] - g.m[1]) -
                      two * z * (g.m[0] + g.m[4]));
  const T along = gw * w + gx * x + gy * y + gz * z;
  grad[0] = s * (gw - along * w);
  grad[1] = s * (gx - along * x);
  grad[2] = s * (gy - along * y);
  grad[3] = s * (gz - along * z);
}

// A splat on the screen. power(d) = (conic_a dx^2 + conic_c dy^2) / 2 + conic_b dx dy;
// alpha = min(0.99, opacity exp(-power)) wherever power <= cutoff.
template <typename T>
struct Splat {
  T x, y;                // centre [px]
  T a, b, c;             // conic [1/px^2]
  T opacity;             // after antialiasing
  T cutoff;              // ln(255 opacity), at most kMaxPower
  T extent_x, extent_y;  // half size of the tight box of the support [px]
  T cov_c;               // vertical variance [px^2]
  T depth;               // camera z
};

// What projection and its adjoint share.
template <typename T>
struct SplatFrame {
  Vec3<T> point;           // camera coordinates
  T inverse_z, u, v;       // 1/z, clamped x/z, y/z
  Flag<T> free_u, free_v;  // clamp not binding
  Vec3<T> row_x, row_y;    // rows of J R, the 2x3 map of world displacements to pixels
  T cov_a, cov_b, cov_c;   // screen covariance before the low-pass [px^2]
  T det0, det;             // determinants before and after the low-pass
};

// False for a point that is not in front of the camera, or not finite.
template <typename T>
GSF_HOST_DEVICE Flag<T> splat_frame_point(const SplatCamera<T>& cam, const Vec3<T>& mean,
                                          SplatFrame<T>* f) {
  f->point = matvec(cam.rotation, mean) + cam.translation;
  f->inverse_z = T(1) / f->point.z;
  const T u = f->point.x * f->inverse_z, v = f->point.y * f->inverse_z;
  f->free_u = (u >= cam.low_u) & (u <= cam.high_u);
  f->free_v = (v >= cam.low_v) & (v <= cam.high_v);
  f->u = clamp(u, cam.low_u, cam.high_u);
  f->v = clamp(v, cam.low_v, cam.high_v);
  const Mat3<T>& r = cam.rotation;
  const T sx = cam.fx * f->inverse_z, sy = cam.fy * f->inverse_z;
  for (int j = 0; j < 3; ++j) {
    f->row_x[j] = sx * (r(0, j) - f->u * r(2, j));
    f->row_y[j] = sy * (r(1, j) - f->v * r(2, j));
  }
  return (f->point.z >= cam.near) & (f->point.z <= cam.far);
}

// det(cov + blur I) written as a sum of non-negative terms: no cancellation for needles.
template <typename T>
GSF_HOST_DEVICE void splat_frame_det(SplatFrame<T>* f) {
  const T blur = T(kScreenBlur);
  f->det = f->det0 + blur * (f->cov_a + f->cov_c) + blur * blur;
}

// Screen covariance of a Gaussian given by axes and scales.
template <typename T>
GSF_HOST_DEVICE void splat_frame_axes(const Mat3<T>& axes, const T* scales, SplatFrame<T>* f) {
  Vec3<T> px, py;
  for (int k = 0; k < 3; ++k) {
    const Vec3<T> axis{axes(0, k), axes(1, k), axes(2, k)};
    px[k] = scales[k] * dot(f->row_x, axis);
    py[k] = scales[k] * dot(f->row_y, axis);
  }
  f->cov_a = dot(px, px);
  f->cov_b = dot(px, py);
  f->cov_c = dot(py, py);
  const Vec3<T> n = cross(px, py);
  f->det0 = dot(n, n);  // Lagrange: |px|^2 |py|^2 - (px.py)^2
  splat_frame_det(f);
}

// Screen covariance of a Gaussian given by its world covariance.
template <typename T>
GSF_HOST_DEVICE void splat_frame_covariance(const Sym3<T>& s, SplatFrame<T>* f) {
  const Mat3<T> m = to_mat3(s);
  const Vec3<T> sx = matvec(m, f->row_x), sy = matvec(m, f->row_y);
  f->cov_a = dot(f->row_x, sx);
  f->cov_b = dot(f->row_x, sy);
  f->cov_c = dot(f->row_y, sy);
  f->det0 = max(f->cov_a * f->cov_c - f->cov_b * f->cov_b, T(0));
  splat_frame_det(f);
}

template <typename T>
GSF_HOST_DEVICE T splat_compensation(const SplatFrame<T>& f) {
  using std::sqrt;
  const T floor = T(kMinCompensation);
  return sqrt(max(f.det0 / f.det, floor * floor));
}

// Pixels [x0, x1) x [y0, y1) whose centres lie in the tight box; empty when off the image.
struct PixelBox {
  int x0, y0, x1, y1;
  GSF_HOST_DEVICE bool empty() const { return x0 >= x1 || y0 >= y1; }
};

// Clamped while still floating, so that huge extents cannot overflow the conversion.
template <typename T>
GSF_HOST_DEVICE PixelBox splat_box(T x, T y, T extent_x, T extent_y, int width, int height) {
  using std::ceil;
  using std::floor;
  const T w = T(width), h = T(height), half = T(0.5);
  return {static_cast<int>(clamp(ceil(x - extent_x - half), T(0), w)),
          static_cast<int>(clamp(ceil(y - extent_y - half), T(0), h)),
          static_cast<int>(clamp(floor(x + extent_x - half) + T(1), T(0), w)),
          static_cast<int>(clamp(floor(y + extent_y - half) + T(1), T(0), h))};
}

// Power beyond which alpha falls below 1/255, at most the support; opacity > 0.
template <typename T>
GSF_HOST_DEVICE T splat_cutoff(T opacity) {
  using std::log;
  return min(log(opacity * T(255)), T(kMaxPower));
}

// Last step of projection; false for what is not a finite splat, or too faint. Whether its box
// touches the image is for the caller. `offset_x`, `offset_y` [px] move the centre.
template <typename T>
GSF_HOST_DEVICE Flag<T> splat_finish(const SplatCamera<T>& cam, const SplatFrame<T>& f, T opacity,
                                     bool antialiased, T offset_x, T offset_y, Splat<T>* s) {
  using std::sqrt;
  const T a = f.cov_a + T(kScreenBlur), c = f.cov_c + T(kScreenBlur), inverse = T(1) / f.det;
  s->a = c * inverse;
  s->b = -f.cov_b * inverse;
  s->c = a * inverse;
  s->opacity = antialiased ? opacity * splat_compensation(f) : opacity;
  s->cutoff = splat_cutoff(s->opacity);
  s->x = cam.fx * f.point.x * f.inverse_z + cam.cx + offset_x;
  s->y = cam.fy * f.point.y * f.inverse_z + cam.cy + offset_y;
  s->extent_x = sqrt(T(2) * max(s->cutoff, T(0)) * a);
  s->extent_y = sqrt(T(2) * max(s->cutoff, T(0)) * c);
  s->cov_c = c;
  s->depth = f.point.z;
  // Written so that NaN fails.
  return (f.det > T(0)) & finite(f.det) & (f.cov_a >= T(0)) & (f.cov_c >= T(0)) &
         (a <= T(kMaxVariance)) & (c <= T(kMaxVariance)) & (s->opacity >= T(kMinAlpha)) &
         finite(s->opacity) & finite(s->x) & finite(s->y) & finite(s->a) & finite(s->b) &
         finite(s->c) & (s->a > T(0)) & (s->c > T(0));
}

// Gradients that reach a splat from the pixels; those of the covariance are entries of the
// symmetric 2x2 matrix (the off-diagonal one counts for each of its two places).
template <typename T>
struct SplatGradient {
  T x, y, cov_a, cov_b, cov_c, opacity, depth;
};

// A Gaussian's shape to the adjoint: rotated axes with standard deviations, or (scales null) the
// world covariance.
template <typename T>
struct SplatShape {
  Mat3<T> axes;
  const T* scales;
  Sym3<T> covariance;
};

// Adjoint of the projection. Returns the gradient of the mean; writes the gradient of the raw
// opacity and that of the covariance (entries of the full symmetric matrix): of the world's, or in
// the frame of the axes. There the entries of a needle, which differ by the square of its
// slenderness, do not mix.
template <typename T>
GSF_HOST_DEVICE Vec3<T> splat_backward(const SplatCamera<T>& cam, const SplatFrame<T>& f,
                                       const SplatShape<T>& shape, T opacity, bool antialiased,
                                       const SplatGradient<T>& g, Mat3<T>* grad_covariance,
                                       T* grad_opacity) {
  T da = g.cov_a, db = g.cov_b, dc = g.cov_c, d_det0 = T(0);
  *grad_opacity = g.opacity;
  if (antialiased) {
    const T a = f.cov_a + T(kScreenBlur), c = f.cov_c + T(kScreenBlur), inverse = T(1) / f.det;
    const T compensation = splat_compensation(f);
    *grad_opacity = g.opacity * compensation;
    const T ratio = f.det0 * inverse;
    d_det0 = select(ratio > T(kMinCompensation) * T(kMinCompensation),
                    g.opacity * opacity * T(0.5) / compensation * inverse, T(0));
    da -= d_det0 * ratio * c;
    dc -= d_det0 * ratio * a;
    db += d_det0 * ratio * f.cov_b;
    if (!shape.scales) {
      da += d_det0 * f.cov_c;
      dc += d_det0 * f.cov_a;
      db -= d_det0 * f.cov_b;
    }
  }
  // The map to the screen, and the covariance times it, in the frame of the shape.
  Vec3<T> mx = f.row_x, my = f.row_y, sx, sy, square{T(0), T(0), T(0)};
  if (shape.scales) {
    const Mat3<T> turned = transpose(shape.axes);
    mx = matvec(turned, mx);
    my = matvec(turned, my);
    for (int k = 0; k < 3; ++k) {
      square[k] = shape.scales[k] * shape.scales[k];
      sx[k] = square[k] * mx[k];
      sy[k] = square[k] * my[k];
    }
  } else {
    const Mat3<T> sigma = to_mat3(shape.covariance);
    sx = matvec(sigma, mx);
    sy = matvec(sigma, my);
  }
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      (*grad_covariance)(i, j) =
          da * mx[i] * mx[j] + db * (mx[i] * my[j] + my[i] * mx[j]) + dc * my[i] * my[j];
  Vec3<T> dmx = T(2) * (da * sx + db * sy), dmy = T(2) * (db * sx + dc * sy);
  if (shape.scales && antialiased) {
    // det0 = sum_k s_i^2 s_j^2 n_k^2 with n = mx x my and i, j the other two: no differences.
    Vec3<T> n = cross(mx, my), dn;
    // infinite of a needle whose part of the gradient is zero
    for (int k = 0; k < 3; ++k) n[k] = select((d_det0 < T(0)) | (d_det0 > T(0)), n[k], T(0));
    for (int k = 0; k < 3; ++k) {
      const int i = (k + 1) % 3, j = (k + 2) % 3;
      dn[k] = T(2) * d_det0 * square[i] * square[j] * n[k];
      (*grad_covariance)(i, i) += d_det0 * square[j] * n[k] * n[k];
      (*grad_covariance)(j, j) += d_det0 * square[i] * n[k] * n[k];
      (*grad_covariance)(i, j) -= d_det0 * square[k] * n[i] * n[j];
      (*grad_covariance)(j, i) -= d_det0 * square[k] * n[i] * n[j];
    }
    dmx = dmx + cross(my, dn);
    dmy = dmy + cross(dn, mx);
  }
  const T along = dot(dmx, mx) + dot(dmy, my);
  if (shape.scales) {
    dmx = matvec(shape.axes, dmx);
    dmy = matvec(shape.axes, dmy);
  }
  // rows = f/z (R_row - u R_2), so their gradients reach 1/z and the clamped u, v.
  const Mat3<T>& r = cam.rotation;
  const Vec3<T> r2{r(2, 0), r(2, 1), r(2, 2)};
  const T z = f.point.z;
  T d_inverse = z * along;
  const T du = -cam.fx * f.inverse_z * dot(dmx, r2), dv = -cam.fy * f.inverse_z * dot(dmy, r2);
  d_inverse += g.x * cam.fx * f.point.x + g.y * cam.fy * f.point.y;
  Vec3<T> dp{g.x * cam.fx * f.inverse_z, g.y * cam.fy * f.inverse_z, g.depth};
  dp.x += select(f.free_u, du * f.inverse_z, T(0));
  d_inverse += select(f.free_u, du * f.point.x, T(0));
  dp.y += select(f.free_v, dv * f.inverse_z, T(0));
  d_inverse += select(f.free_v, dv * f.point.y, T(0));
  dp.z -= f.inverse_z * f.inverse_z * d_inverse;
  return matvec(transpose(r), dp);
}

// Covariance gradient in the frame of the axes -> gradients of scales and quaternion.
template <typename T>
GSF_HOST_DEVICE void splat_axes_backward(const Mat3<T>& axes, const T* scales, const T* quat,
                                         const Mat3<T>& grad_covariance, T* grad_scales,
                                         T* grad_quat) {
  Mat3<T> grad_axes;
  for (int k = 0; k < 3; ++k) {
    const Vec3<T> h{grad_covariance(0, k), grad_covariance(1, k), grad_covariance(2, k)};
    const Vec3<T> world = matvec(axes, h);  // dSigma/d(axis) = 2 s^2 G axis
    grad_scales[k] = T(2) * scales[k] * h[k];
    for (int i = 0; i < 3; ++i) grad_axes(i, k) = T(2) * scales[k] * scales[k] * world[i];
  }
  rotation_from_quat_backward(quat, grad_axes, grad_quat);
}

}  // namespace gsf
