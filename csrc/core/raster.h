// Arguments of the rasterizer's kernels: plain pointers and sizes, the same for CPU and CUDA, and
// the per-splat steps both run (load a Gaussian, project it, take its gradients back).
#pragma once

#include "core/splat.h"

namespace gsf {

// Row of `splats`: the header below, then the blended features (colours, normal, depth).
enum SplatField : int {
  kX,
  kY,
  kConicA,
  kConicB,
  kConicC,
  kOpacity,
  kCutoff,
  kExtentX,
  kExtentY,
  kFeatures
};
constexpr int kMaxChannels = 32;
constexpr int kMaxFeatures = kMaxChannels + 4;
// Gradient of one splat from the pixels: x, y, conic a, b, c, opacity, then the features.
constexpr int kGradFeatures = 6;

GSF_HOST_DEVICE constexpr int splat_stride(int features) {
  return (kFeatures + features + 3) / 4 * 4;
}

// Optional pointers are null when the argument was not given.
template <typename T>
struct RasterArgs {
  const T* means;      // [N, 3]
  const T* opacities;  // [N]
  const T* quats;      // [N, 4] with scales [N, 3], or covars [N, 6]
  const T* scales;
  const T* covars;
  const T* sh;  // [N, (degree + 1)^2, 3], or colors [N, C]
  const T* colors;
  const T* normals;       // [N, 3]
  const T* background;    // [C]
  const T* offset;        // [N, 2]
  const int32_t* groups;  // [N]
  const T* viewmat;       // [4, 4]
  const T* intrinsics;    // [3, 3]
  int64_t count;
  int sh_degree, channels, features, stride;
  int width, height, tiles_x, tiles_y;
  bool antialiased, has_normals;
  T near, far;

  T* splats;            // [N, stride]; row order is the backend's own
  int32_t* order;       // [N] Gaussians by depth; on the CPU, row r of `splats` is Gaussian
                        // order[r], and -1 stands beyond the visible ones
  int32_t* tile_start;  // [tiles + 1] ranges of `instances`
  int32_t* instances;   // [I] rows of `splats`, by tile, front to back
  int64_t instance_count;
  int32_t* radii;   // [N]
  T* image;         // [H, W, C]
  T* alpha;         // [H, W]
  T* depth;         // [H, W]
  T* normal;        // [H, W, 3] or null
  T* contribution;  // [N] or null
};

template <typename T>
struct RasterGradArgs {
  RasterArgs<T> forward;
  const T* grad_image;  // any of the four may be null (zero)
  const T* grad_alpha;
  const T* grad_depth;
  const T* grad_normal;
  T* grad_means;  // outputs, zeroed by the caller; null where the input is null
  T* grad_opacities;
  T* grad_quats;
  T* grad_scales;
  T* grad_covars;
  T* grad_sh;
  T* grad_colors;
  T* grad_normals;
  T* grad_background;
  T* grad_offset;
};

template <typename T>
GSF_HOST_DEVICE SplatCamera<T> raster_camera(const RasterArgs<T>& a) {
  return make_splat_camera(a.viewmat, a.intrinsics, a.width, a.height, a.near, a.far);
}

// Colour of Gaussian `i` and, for the adjoint, the basis and the view direction.
template <typename T>
GSF_HOST_DEVICE Vec3<T> view_direction(const SplatCamera<T>& cam, const Vec3<T>& mean, T* length) {
  const Vec3<T> d = mean - cam.centre;
  *length = max(norm(d), T(1e-12));
  return (T(1) / *length) * d;
}

// Projects Gaussian `i` and writes its row; false (row untouched) when it cannot be seen.
template <typename T>
GSF_HOST_DEVICE bool project_splat(const RasterArgs<T>& a, const SplatCamera<T>& cam, int64_t i,
                                   T* row, T* depth, int32_t* radius) {
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
  Splat<T> s;
  const T ox = a.offset ? a.offset[2 * i] : T(0), oy = a.offset ? a.offset[2 * i + 1] : T(0);
  if (!splat_finish(cam, frame, a.opacities[i], a.antialiased, ox, oy, &s)) return false;

  T* feature = row + kFeatures;
  bool good = true;
  if (a.sh) {
    T length, basis[kMaxShCoefficients];
    const int k = sh_coefficients(a.sh_degree);
    sh_basis(a.sh_degree, view_direction(cam, mean, &length), basis);
    const T* c = a.sh + 3 * k * i;
    for (int ch = 0; ch < 3; ++ch) {
      T sum = T(0.5);
      for (int j = 0; j < k; ++j) sum += basis[j] * c[3 * j + ch];
      good = good && finite(sum);
      feature[ch] = max(sum, T(0));
    }
  } else {
    for (int ch = 0; ch < a.channels; ++ch) {
      feature[ch] = a.colors[a.channels * i + ch];
      good = good && finite(feature[ch]);
    }
  }
  if (a.has_normals) {
    for (int j = 0; j < 3; ++j) {
      feature[a.channels + j] = a.normals[3 * i + j];
      good = good && finite(feature[a.channels + j]);
    }
  }
  if (!good) return false;
  feature[a.features - 1] = s.depth;
  row[kX] = s.x;
  row[kY] = s.y;
  row[kConicA] = s.a;
  row[kConicB] = s.b;
  row[kConicC] = s.c;
  row[kOpacity] = s.opacity;
  row[kCutoff] = s.cutoff;
  row[kExtentX] = s.extent_x;
  row[kExtentY] = s.extent_y;
  *depth = s.depth;
  using std::ceil;
  *radius = static_cast<int32_t>(ceil(min(max(s.extent_x, s.extent_y), T(1 << 24))));
  return true;
}

// Takes the pixels' gradient of one splat, `g` (layout kGradFeatures), to the inputs of Gaussian
// `i`. The splat was visible, so every input is finite.
template <typename T>
GSF_HOST_DEVICE void project_splat_backward(const RasterGradArgs<T>& b, const SplatCamera<T>& cam,
                                            int64_t i, const T* g) {
  const RasterArgs<T>& a = b.forward;
  const Vec3<T> mean{a.means[3 * i], a.means[3 * i + 1], a.means[3 * i + 2]};
  SplatFrame<T> frame;
  if (!splat_frame_point(cam, mean, &frame)) return;
  Mat3<T> axes = identity3<T>();
  Sym3<T> covariance;
  if (a.covars) {
    covariance = load_sym3(a.covars + 6 * i);
    splat_frame_covariance(covariance, &frame);
  } else {
    if (!rotation_from_quat(a.quats + 4 * i, &axes)) return;
    splat_frame_axes(axes, a.scales + 3 * i, &frame);
    covariance = splat_covariance(axes, a.scales + 3 * i);
  }
  const T* feature = g + kGradFeatures;
  const SplatGradient<T> pixel{g[0], g[1], g[2], g[3], g[4], g[5], feature[a.features - 1]};
  Mat3<T> grad_covariance;
  Vec3<T> grad_mean = splat_backward(cam, frame, covariance, a.opacities[i], a.antialiased, pixel,
                                     &grad_covariance, b.grad_opacities + i);
  if (a.covars) {
    // The six numbers stand for the full symmetric matrix: off-diagonal entries count twice.
    T* out = b.grad_covars + 6 * i;
    out[0] = grad_covariance(0, 0);
    out[1] = grad_covariance(1, 1);
    out[2] = grad_covariance(2, 2);
    out[3] = 2 * grad_covariance(0, 1);
    out[4] = 2 * grad_covariance(0, 2);
    out[5] = 2 * grad_covariance(1, 2);
  } else {
    splat_axes_backward(axes, a.scales + 3 * i, a.quats + 4 * i, grad_covariance,
                        b.grad_scales + 3 * i, b.grad_quats + 4 * i);
  }
  if (a.sh) {
    T length, basis[kMaxShCoefficients], weight[kMaxShCoefficients];
    const int k = sh_coefficients(a.sh_degree);
    const Vec3<T> d = view_direction(cam, mean, &length);
    sh_basis(a.sh_degree, d, basis);
    const T* c = a.sh + 3 * k * i;
    T* out = b.grad_sh + 3 * k * i;
    for (int j = 0; j < k; ++j) weight[j] = T(0);
    for (int ch = 0; ch < 3; ++ch) {
      T sum = T(0.5);
      for (int j = 0; j < k; ++j) sum += basis[j] * c[3 * j + ch];
      if (!(sum > T(0))) continue;  // clamped at zero: no gradient
      for (int j = 0; j < k; ++j) {
        out[3 * j + ch] = feature[ch] * basis[j];
        weight[j] += feature[ch] * c[3 * j + ch];
      }
    }
    const Vec3<T> gd = sh_basis_gradient(a.sh_degree, d, weight);
    grad_mean = grad_mean + (T(1) / length) * (gd - dot(gd, d) * d);
  } else {
    for (int ch = 0; ch < a.channels; ++ch) b.grad_colors[a.channels * i + ch] = feature[ch];
  }
  if (a.has_normals)
    for (int j = 0; j < 3; ++j) b.grad_normals[3 * i + j] = feature[a.channels + j];
  if (b.grad_offset) {
    b.grad_offset[2 * i] = g[0];
    b.grad_offset[2 * i + 1] = g[1];
  }
  for (int j = 0; j < 3; ++j) b.grad_means[3 * i + j] = grad_mean[j];
}

// The tiles a pixel box touches, [x0, x1) x [y0, y1).
GSF_HOST_DEVICE PixelBox tile_box(const PixelBox& p) {
  return {p.x0 / kTile, p.y0 / kTile, (p.x1 + kTile - 1) / kTile, (p.y1 + kTile - 1) / kTile};
}

template <typename T>
GSF_HOST_DEVICE PixelBox splat_tiles(const T* row, int width, int height) {
  return tile_box(splat_box(row[kX], row[kY], row[kExtentX], row[kExtentY], width, height));
}

}  // namespace gsf
