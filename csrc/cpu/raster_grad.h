// The adjoint on the CPU: one tile (every instance writes one row of sums), then one Gaussian (its
// rows are added in a fixed order and taken to the inputs).
#pragma once

#include <atomic>

#include "cpu/raster_tile.h"

namespace gsf::raster_cpu {

// What one call of the adjoint works on, beside the arguments.
template <typename T>
struct GradSlots {
  // Features are colours, normal, depth: those behind the last wanted one are left out.
  int active;
  int width;  // numbers per instance: moments, `active` features, two absolute sums when wanted
  T* rows;    // [I, width], splat by splat
  std::atomic<bool>* unsound;

  T* row(int64_t slot) const { return rows + slot * width; }
};

// Adjoint of blend_tile. Per instance it writes one row of slots: the moments of the opacity
// gradient (sum v dx, v dy, v dx^2, v dx dy, v dy^2, v with v = dL/d ln alpha), the gradients of
// the features, then sum |dL/dx|, |dL/dy| of the centre. `background` is this tile's share
// [channels], or null. kF: features when known at compile time, else 0.
template <typename T, int kF, bool kGroups, bool kAbsolute>
void blend_tile_backward(const RasterGradArgs<T>& b, int64_t tile, const GradSlots<T>& slots,
                         T* background) {
  const RasterArgs<T>& a = b.forward;
  const int active = kF ? kF : slots.active;
  const TileArea area = tile_area(a, tile);
  const int64_t first = area.camera * a.count;
  BlockWalk<T, kGroups> walk;
  walk.reset(area.width, area.height);
  alignas(32) Pack<T> grad[kF ? kF : kMaxFeatures][kBlocks<T>];
  // What everything from the current splat to the back adds to the loss:
  // g.(blended features + T bg) - g_alpha T, reduced splat by splat.
  alignas(32) Pack<T> behind[kBlocks<T>];
  for (int f = 0; f < active; ++f)
    for (auto& block : grad[f]) block = Pack<T>{};
  for (auto& block : behind) block = Pack<T>{};
  for (int y = 0; y < area.height; ++y) {
    for (int x = 0; x < area.width; ++x) {
      const int block = x / kLanes<T> * kTileEdge + y, lane = x % kLanes<T>;
      const int64_t pixel = pixel_index(a, area, x, y);
      const T alpha = a.alpha[pixel], left = T(1) - alpha;
      T total = T(0);
      for (int c = 0; c < a.channels && b.grad_image; ++c) {
        const T g = b.grad_image[pixel * a.channels + c];
        grad[c][block][lane] = g;
        total += g * a.image[pixel * a.channels + c];
        if (background) background[c] += g * left;
      }
      for (int c = 0; c < 3 && b.grad_normal; ++c) {
        const T g = b.grad_normal[3 * pixel + c];
        grad[a.channels + c][block][lane] = g;
        total += g * a.normal[3 * pixel + c];
      }
      T grad_alpha = b.grad_alpha ? b.grad_alpha[pixel] : T(0);
      if (b.grad_depth && alpha > T(0)) {
        const T g = b.grad_depth[pixel];
        grad[active - 1][block][lane] = g / alpha;
        grad_alpha -= g * a.depth[pixel] / alpha;
        total += g * a.depth[pixel];
      }
      behind[block][lane] = total - grad_alpha * left;
    }
  }

  const T tile_x = T(area.x), tile_y = T(area.y);
  const int32_t end = a.tile_start[tile + 1];
  int32_t e = a.tile_start[tile];
  for (; e < end && walk.alive; ++e) {
    prefetch_instance(a, a.order, e, end);
    const int32_t s = a.instances[e];
    const T* splat = a.splats + int64_t(s) * a.stride;
    int group = -1;
    if constexpr (kGroups) group = a.groups[s - first];
    Pack<T> moment[kGradFeatures] = {};
    Pack<T> feature[kF ? kF : kMaxFeatures];
    Pack<T> absolute[2] = {};
    for (int f = 0; f < active; ++f) feature[f] = Pack<T>{};
    for (uint64_t bits = reached_blocks(splat, tile_x, tile_y) & walk.alive; bits;
         bits &= bits - 1) {
      const int block = __builtin_ctzll(bits);
      const auto w = walk.weigh(splat, group, block, tile_x, tile_y);
      Pack<T> along{};
      for (int f = 0; f < active; ++f) {
        along += grad[f][block] * splat[kFeatures + f];
        feature[f] += w.weight * grad[f][block];
      }
      const Pack<T> rest = behind[block] - w.weight * along;
      behind[block] = rest;
      const Pack<T> v = w.open ? w.weight * along - w.alpha * rest / (T(1) - w.alpha) : Pack<T>{};
      const Pack<T> vx = v * w.dx;
      moment[0] += vx;
      moment[1] += v * w.dy;
      moment[2] += vx * w.dx;
      moment[3] += vx * w.dy;
      moment[4] += v * (w.dy * w.dy);
      moment[5] += v;
      if constexpr (kAbsolute) {
        absolute[0] += pack_abs<T>(v * (splat[kConicA] * w.dx + splat[kConicB] * w.dy));
        absolute[1] += pack_abs<T>(v * (splat[kConicB] * w.dx + splat[kConicC] * w.dy));
      }
    }
    const int64_t place = instance_slot(a, s, area);
    if (place < 0) {
      *slots.unsound = true;
      continue;
    }
    T* row = slots.row(place);
    for (int k = 0; k < kGradFeatures; ++k) row[k] = pack_sum<T>(moment[k]);
    for (int f = 0; f < active; ++f) row[kGradFeatures + f] = pack_sum<T>(feature[f]);
    if constexpr (kAbsolute)
      for (int k = 0; k < 2; ++k) row[kGradFeatures + active + k] = pack_sum<T>(absolute[k]);
  }
  for (; e < end; ++e) {
    const int64_t place = instance_slot(a, a.instances[e], area);
    if (place < 0)
      *slots.unsound = true;
    else
      std::fill_n(slots.row(place), slots.width, T(0));
  }
}

// Nobody saw Gaussian `i`: its inputs may hold anything, its gradients are zero.
template <typename T>
void clear_gradient(const RasterGradArgs<T>& b, int64_t i) {
  const RasterArgs<T>& a = b.forward;
  const auto clear = [&](T* out, int64_t width) {
    if (out) std::fill_n(out + i * width, width, T(0));
  };
  clear(b.grad_means, 3);
  clear(b.grad_opacities, 1);
  clear(b.grad_quats, 4);
  clear(b.grad_scales, 3);
  clear(b.grad_covars, 6);
  if (a.sh) clear(b.grad_sh, 3 * sh_coefficients(a.sh_degree));
  clear(b.grad_colors, a.channels);
  clear(b.grad_normals, 3);
}

// Sums the rows of Gaussian `i` camera by camera, turns moments into gradients of the projected
// splat and takes those to the inputs.
template <typename T>
void gaussian_backward(const RasterGradArgs<T>& b, const std::vector<SplatCamera<T>>& cameras,
                       int64_t i, const GradSlots<T>& slots) {
  const RasterArgs<T>& a = b.forward;
  clear_gradient(b, i);
  GaussianGradient<T> total;
  bool any = false;
  for (int camera = 0; camera < a.cameras; ++camera) {
    const int64_t s = camera * a.count + i;
    const int64_t begin = a.order[s],
                  end = s + 1 < a.splat_count() ? int64_t(a.order[s + 1]) : a.instance_count;
    T sum[kGradFeatures + kMaxFeatures + 2] = {};
    for (int64_t slot = begin; slot < end; ++slot)
      for (int k = 0; k < slots.width; ++k) sum[k] += slots.row(slot)[k];
    bool seen = false;
    for (int k = 0; k < slots.width; ++k) seen = seen || sum[k] != T(0);
    T g[kGradFeatures] = {};
    if (seen) {
      const T* row = a.splats + s * a.stride;
      moments_to_gradient(sum, row[kConicA], row[kConicB], row[kConicC], row[kOpacity], g);
    }
    if (b.grad_offset) std::copy_n(g, 2, b.grad_offset + 2 * s);
    if (b.grad_absolute) {
      const T* absolute = sum + slots.width - 2;
      std::copy_n(absolute, 2, b.grad_absolute + 2 * s);
    }
    if (!seen) continue;
    any = true;
    T* feature = sum + kGradFeatures;
    const T depth = b.grad_depth ? feature[slots.active - 1] : T(0);
    geometry_backward(a, cameras[camera], i, g, depth, &total);
    if (a.sh) {
      const int64_t at = 3 * sh_coefficients(a.sh_degree) * i;
      const Vec3<T> mean{a.means[3 * i], a.means[3 * i + 1], a.means[3 * i + 2]};
      if (slots.active >= 3)
        sh_backward(a.sh_degree, cameras[camera], mean, a.sh + at, feature, b.grad_sh + at,
                    &total.mean);
    } else {
      for (int c = 0; c < std::min(a.channels, slots.active); ++c)
        b.grad_colors[a.channels * i + c] += feature[c];
    }
    if (slots.active >= a.channels + 3 && a.has_normals)
      for (int k = 0; k < 3; ++k) b.grad_normals[3 * i + k] += feature[a.channels + k];
  }
  if (any) store_gaussian_gradient(b, i, total);
}

}  // namespace gsf::raster_cpu
