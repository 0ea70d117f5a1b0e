// Arguments of the rasterizer's kernels: plain pointers and sizes, the same for CPU and CUDA, and
// the per-splat steps both run (project a Gaussian, evaluate its features, take gradients back).
#pragma once

#include "core/raster/splat.h"

namespace gsf {

constexpr int kMaxChannels = 32;
constexpr int kMaxFeatures = kMaxChannels + 4;
// Gradient of one splat from the pixels: x, y, conic a, b, c, opacity, then the features.
constexpr int kGradFeatures = 6;

// Splats are counted camera by camera: splat `camera * count + i` is Gaussian i in that camera.
// Optional pointers are null when the argument was not given or the output is not wanted.
template <typename T>
struct RasterArgs {
  const T* means;      // [N, 3]
  const T* opacities;  // [N]
  const T* quats;      // [N, 4] with scales [N, 3], or covars [N, 6]
  const T* scales;
  const T* covars;
  const T* sh;  // [N, (degree + 1)^2, 3], or colors [N, channels]
  const T* colors;
  const T* normals;       // [N, vectors]: x, y, z and what else is blended
  const T* background;    // [channels], or [C, channels] with background_stride = channels
  const T* offset;        // [C, N, 2]
  const int32_t* groups;  // [N]
  const T* viewmat;       // [C, 4, 4]
  const T* intrinsics;    // [C, 3, 3]
  int64_t count;          // N
  int cameras;            // C
  int sh_degree, channels, features, stride, background_stride;
  int vectors;  // columns of `normals`, 0 without
  int width, height;
  int tile, tiles_x, tiles_y;  // tile edge [px] of the lists, tiles of one camera's image
  bool antialiased, has_depth;
  T near, far;

  // Saved for the adjoint; the layout of the first three is the backend's own.
  T* splats;            // [C N, stride]
  int32_t* order;       // [C N] or empty
  int32_t* tile_start;  // [C tiles + 1] ranges of `instances`
  int32_t* instances;   // [I] by tile, front to back
  int64_t instance_count;

  int32_t* radii;   // [C, N]
  T* image;         // [C, H, W, channels]
  T* alpha;         // [C, H, W]
  T* depth;         // [C, H, W], when has_depth
  T* median;        // [C, H, W] or null
  T* normal;        // [C, H, W, vectors]
  T* contribution;  // [N] or null

  GSF_HOST_DEVICE int64_t splat_count() const { return count * cameras; }
  GSF_HOST_DEVICE int tiles() const { return tiles_x * tiles_y; }
  // What shines through channel `c`; held where features are.
  GSF_HOST_DEVICE T background_color(int camera, int c) const {
    const T* color = background_of(camera);
    return color ? clamp(color[c], T(-kMaxFeature), T(kMaxFeature)) : T(0);
  }
  GSF_HOST_DEVICE const T* background_of(int camera) const {
    return background ? background + int64_t(camera) * background_stride : nullptr;
  }
};

template <typename T>
struct RasterGradArgs {
  RasterArgs<T> forward;
  const T* grad_image;  // any of the four may be null (zero)
  const T* grad_alpha;
  const T* grad_depth;
  const T* grad_normal;
  T* grad_means;  // outputs; null where the input is null
  T* grad_opacities;
  T* grad_quats;
  T* grad_scales;
  T* grad_covars;
  T* grad_sh;
  T* grad_colors;
  T* grad_normals;
  T* grad_background;  // zeroed by the host
  T* grad_offset;      // [C, N, 2]
  T* grad_absolute;    // [C, N, 2]
  bool deterministic;  // sums must not depend on an order that is chance (CUDA; the CPU has none)
};

template <typename T>
GSF_HOST_DEVICE SplatCamera<T> raster_camera(const RasterArgs<T>& a, int camera) {
  return make_splat_camera(a.viewmat + 16 * camera, a.intrinsics + 9 * camera, a.width, a.height,
                           a.near, a.far);
}

template <typename T>
GSF_HOST_DEVICE Vec3<T> view_direction(const SplatCamera<T>& cam, const Vec3<T>& mean, T* length) {
  const Vec3<T> d = mean - cam.centre;
  *length = max(norm(d), T(1e-12));
  return (T(1) / *length) * d;
}

// Projects Gaussian `i` as splat `row`; false when it cannot be seen.
template <typename T>
GSF_HOST_DEVICE bool project_geometry(const RasterArgs<T>& a, const SplatCamera<T>& cam, int64_t i,
                                      int64_t row, Splat<T>* s) {
  const Vec3<T> mean{a.means[3 * i], a.means[3 * i + 1], a.means[3 * i + 2]};
  SplatFrame<T> frame;
  if (!splat_frame_point(cam, mean, &frame)) return false;
  if (a.covars) {
    splat_frame_covariance(load_sym3(a.covars + 6 * i), &frame);
  } else {
    Mat3<T> axes;
    if (!rotation_from_quat(a.quats + 4 * i, &axes)) return false;
    splat_frame_axes(axes, a.scales + 3 * i, &frame);
  }
  const T ox = a.offset ? a.offset[2 * row] : T(0), oy = a.offset ? a.offset[2 * row + 1] : T(0);
  return splat_finish(cam, frame, a.opacities[i], a.antialiased, ox, oy, s) &&
         !splat_box(s->x, s->y, s->extent_x, s->extent_y, cam.width, cam.height).empty();
}

// False for what is not drawn, NaN among it.
template <typename T>
GSF_HOST_DEVICE bool drawable(T x) {
  return x >= T(-kMaxFeature) && x <= T(kMaxFeature);
}

// rgb = max(0, sum_k basis_k c_k + 0.5) of the coefficients `c` [(degree + 1)^2, 3]; false when
// that cannot be drawn.
template <typename T>
GSF_HOST_DEVICE bool sh_color(int degree, const Vec3<T>& direction, const T* c, T* rgb) {
  T basis[kMaxShCoefficients];
  const int k = sh_coefficients(degree);
  sh_basis(degree, direction, basis);
  bool good = true;
  for (int ch = 0; ch < 3; ++ch) {
    T sum = T(0.5);
    for (int j = 0; j < k; ++j) sum += basis[j] * c[3 * j + ch];
    good = good && drawable(sum);
    rgb[ch] = max(sum, T(0));
  }
  return good;
}

// Colours, normal and depth of Gaussian `i` in the order in which they are blended. `sh` are its
// coefficients (null when plain colours are given), `direction` is that of the view. False when one
// cannot be drawn.
template <typename T>
GSF_HOST_DEVICE bool splat_features(const RasterArgs<T>& a, const Vec3<T>& direction, int64_t i,
                                    int degree, const T* sh, T depth, T* feature) {
  bool good = true;
  if (sh) {
    good = sh_color(degree, direction, sh, feature);
  } else {
    for (int ch = 0; ch < a.channels; ++ch) {
      feature[ch] = a.colors[a.channels * i + ch];
      good = good && drawable(feature[ch]);
    }
  }
  for (int j = 0; j < a.vectors; ++j) {
    feature[a.channels + j] = a.normals[a.vectors * i + j];
    good = good && drawable(feature[a.channels + j]);
  }
  if (a.has_depth) feature[a.features - 1] = depth;
  return good;
}

// Half size of the splat's box [px], for the caller.
template <typename T>
GSF_HOST_DEVICE int32_t splat_radius(const Splat<T>& s) {
  using std::ceil;
  return static_cast<int32_t>(ceil(min(max(s.extent_x, s.extent_y), T(1 << 24))));
}

// A splat's conic as a sum of squares: power / ln 2 = across^2 + down^2 with
// across = conic.across (dx - slope dy), down = conic.down dy. Neither cancels, however thin the
// splat is, and both stay below 3 within the support. Powers of two, because those are cheap.
constexpr double kLog2E = 1.4426950408889634;
template <typename T>
struct SplatConic {
  T across, slope, down;

  GSF_HOST_DEVICE static SplatConic of(const Splat<T>& s) {
    using std::sqrt;
    const T half = T(0.5 * kLog2E);
    return {sqrt(half * s.a), -s.b / s.a, sqrt(half / s.cov_c)};  // c - b^2 / a = 1 / cov_c
  }
};

// Sums of v across, v down, v across^2, v across down, v down^2, v over the pixels, with
// v = dL/d ln alpha, become gradients of centre, covariance (entries of the symmetric matrix) and
// opacity (of the splat, after antialiasing). With e the conic times the distance to the centre,
// linear in across and down: d ln alpha = e . dcentre + e e^T : dcovariance / 2.
template <typename T>
GSF_HOST_DEVICE void moments_to_gradient(const T* moment, const SplatConic<T>& conic, T opacity,
                                         T* g) {
  const T x = T(2 / kLog2E) * conic.across, y = T(2 / kLog2E) * conic.down, z = -conic.slope * x;
  const T xx = x * moment[2], xy = x * moment[3], yy = y * moment[4];
  g[0] = x * moment[0];
  g[1] = z * moment[0] + y * moment[1];
  g[2] = T(0.5) * x * xx;
  g[3] = T(0.5) * (z * xx + y * xy);
  g[4] = T(0.5) * (z * z * moment[2] + T(2) * y * z * moment[3] + y * yy);
  g[5] = moment[5] / opacity;
}

// Gradient of one Gaussian, summed over the cameras that saw it.
template <typename T>
struct GaussianGradient {
  Vec3<T> mean{T(0), T(0), T(0)};
  Mat3<T> covariance{};  // as splat_backward gives it
  T opacity = T(0);
};

// Adds what `g` (as from moments_to_gradient; the depth's gradient is `depth`) says of one camera
// that saw the Gaussian, where `wanted`. Every input is finite then. A part that leaves T's range
// although `g` did not (a focal length or scale near the end of the range) is left out.
template <typename T>
GSF_HOST_DEVICE void geometry_gradient(const SplatCamera<T>& cam, const Vec3<T>& mean,
                                       const SplatShape<T>& shape, T opacity, bool antialiased,
                                       const T* g, T depth, Flag<T> wanted,
                                       GaussianGradient<T>* total) {
  SplatFrame<T> frame;
  wanted = wanted & splat_frame_point(cam, mean, &frame);
  if (shape.scales)
    splat_frame_axes(shape.axes, shape.scales, &frame);
  else
    splat_frame_covariance(shape.covariance, &frame);
  const SplatGradient<T> pixel{g[0], g[1], g[2], g[3], g[4], g[5], depth};
  Mat3<T> grad_covariance;
  T grad_opacity;
  const Vec3<T> grad_mean = splat_backward(cam, frame, shape, opacity, antialiased, pixel,
                                           &grad_covariance, &grad_opacity);
  T all = grad_mean.x + grad_mean.y + grad_mean.z + grad_opacity;
  for (int k = 0; k < 9; ++k) all += grad_covariance.m[k];
  const T given = g[0] + g[1] + g[2] + g[3] + g[4] + g[5] + depth;
  wanted = wanted & (finite(all) | (finite(given) == Flag<T>{}));
  for (int k = 0; k < 3; ++k) total->mean[k] += select(wanted, grad_mean[k], T(0));
  for (int k = 0; k < 9; ++k) total->covariance.m[k] += select(wanted, grad_covariance.m[k], T(0));
  total->opacity += select(wanted, grad_opacity, T(0));
}

// The same of Gaussian `i`.
template <typename T>
GSF_HOST_DEVICE void geometry_backward(const RasterArgs<T>& a, const SplatCamera<T>& cam, int64_t i,
                                       const T* g, T depth, GaussianGradient<T>* total) {
  SplatShape<T> shape{};
  if (a.covars) {
    shape.covariance = load_sym3(a.covars + 6 * i);
  } else {
    if (!rotation_from_quat(a.quats + 4 * i, &shape.axes)) return;
    shape.scales = a.scales + 3 * i;
  }
  geometry_gradient(cam, load_vec3(a.means + 3 * i), shape, a.opacities[i], a.antialiased, g, depth,
                    true, total);
}

// First half of the colour's adjoint: drops the channels of `grad_rgb` that the clamp at zero held,
// adds the part of the mean's gradient that comes through the view direction, and leaves the basis.
template <typename T>
GSF_HOST_DEVICE void sh_direction_backward(int degree, const SplatCamera<T>& cam,
                                           const Vec3<T>& mean, const T* c, T* grad_rgb, T* basis,
                                           Vec3<T>* grad_mean) {
  T length, weight[kMaxShCoefficients];
  const int k = sh_coefficients(degree);
  const Vec3<T> d = view_direction(cam, mean, &length);
  sh_basis(degree, d, basis);
  for (int ch = 0; ch < 3; ++ch) {
    T sum = T(0.5);
    for (int j = 0; j < k; ++j) sum += basis[j] * c[3 * j + ch];
    if (!(sum > T(0))) grad_rgb[ch] = T(0);
  }
  for (int j = 0; j < k; ++j)
    weight[j] = grad_rgb[0] * c[3 * j] + grad_rgb[1] * c[3 * j + 1] + grad_rgb[2] * c[3 * j + 2];
  const Vec3<T> gd = sh_basis_gradient(degree, d, weight);
  const Vec3<T> part = (T(1) / length) * (gd - dot(gd, d) * d);
  // Coefficients near the end of T's range, which cancel in the colour, do not cancel here.
  if (!finite(part.x + part.y + part.z) && finite(grad_rgb[0] + grad_rgb[1] + grad_rgb[2])) return;
  *grad_mean = *grad_mean + part;
}

// Adjoint of the colour: adds the gradient of the coefficients to `out` [(degree + 1)^2, 3].
template <typename T>
GSF_HOST_DEVICE void sh_backward(int degree, const SplatCamera<T>& cam, const Vec3<T>& mean,
                                 const T* c, const T* grad_rgb, T* out, Vec3<T>* grad_mean) {
  T basis[kMaxShCoefficients], rgb[3] = {grad_rgb[0], grad_rgb[1], grad_rgb[2]};
  sh_direction_backward(degree, cam, mean, c, rgb, basis, grad_mean);
  for (int j = 0; j < sh_coefficients(degree); ++j)
    for (int ch = 0; ch < 3; ++ch) out[3 * j + ch] += rgb[ch] * basis[j];
}

// Writes the summed gradient of Gaussian `i`: means, opacities, and covars or quats and scales.
template <typename T>
GSF_HOST_DEVICE void store_gaussian_gradient(const RasterGradArgs<T>& b, int64_t i,
                                             const GaussianGradient<T>& total) {
  const RasterArgs<T>& a = b.forward;
  for (int j = 0; j < 3; ++j) b.grad_means[3 * i + j] = total.mean[j];
  b.grad_opacities[i] = total.opacity;
  if (a.covars) {
    // The six numbers stand for the full symmetric matrix: off-diagonal entries count twice.
    T* out = b.grad_covars + 6 * i;
    out[0] = total.covariance(0, 0);
    out[1] = total.covariance(1, 1);
    out[2] = total.covariance(2, 2);
    out[3] = 2 * total.covariance(0, 1);
    out[4] = 2 * total.covariance(0, 2);
    out[5] = 2 * total.covariance(1, 2);
    return;
  }
  T *grad_scales = b.grad_scales + 3 * i, *grad_quats = b.grad_quats + 4 * i;
  Mat3<T> axes;
  T all = T(0);
  if (rotation_from_quat(a.quats + 4 * i, &axes)) {
    splat_axes_backward(axes, a.scales + 3 * i, a.quats + 4 * i, total.covariance, grad_scales,
                        grad_quats);
    for (int j = 0; j < 3; ++j) all += grad_scales[j];
    for (int j = 0; j < 4; ++j) all += grad_quats[j];
    T given = T(0);
    for (int j = 0; j < 9; ++j) given += total.covariance.m[j];
    if (finite(all) || !finite(given)) return;
  }
  for (int j = 0; j < 3; ++j) grad_scales[j] = T(0);
  for (int j = 0; j < 4; ++j) grad_quats[j] = T(0);
}

// The tiles of edge `tile` that a pixel box touches, [x0, x1) x [y0, y1).
GSF_HOST_DEVICE PixelBox tile_box(const PixelBox& p, int tile) {
  return {p.x0 / tile, p.y0 / tile, (p.x1 + tile - 1) / tile, (p.y1 + tile - 1) / tile};
}

}  // namespace gsf
