// The adjoint on the CPU: one tile (every instance writes one row of sums), then one Gaussian (its
// rows are added in a fixed order and taken to the inputs).
#pragma once

#ifdef __linux__
#include <sys/mman.h>
#endif

#include <atomic>
#include <cstdlib>
#include <new>

#include "cpu/raster/packet.h"
#include "cpu/raster/tile.h"

namespace gsf::raster_cpu {

// Scratch of one call, not initialised. Large pages where the system has them: the sums of a frame
// take tens of megabytes, and a fault for every 4 KB of them took a tenth of the adjoint's time.
template <typename T>
class Scratch {
 public:
  explicit Scratch(size_t count) {
    const size_t page = count * sizeof(T) < 2 * kPage ? 64 : kPage;
    const size_t bytes = (count * sizeof(T) / page + 1) * page;
    data_ = static_cast<T*>(std::aligned_alloc(page, bytes));
    if (!data_) throw std::bad_alloc();
#ifdef MADV_HUGEPAGE
    if (page == kPage) madvise(data_, bytes, MADV_HUGEPAGE);
#endif
  }
  ~Scratch() { std::free(data_); }
  Scratch(const Scratch&) = delete;
  Scratch& operator=(const Scratch&) = delete;
  T* get() const { return data_; }

 private:
  static constexpr size_t kPage = size_t(1) << 21;
  T* data_;
};

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
// gradient (see moments_to_gradient), the gradients of the features, then sum |dL/dx|, |dL/dy| of
// the centre. `background` is this tile's share [channels], or null. kF: features when known at
// compile time, else 0.
template <typename T, int kF, bool kGroups, bool kAbsolute>
void blend_tile_backward(const RasterGradArgs<T>& b, int64_t tile, const GradSlots<T>& slots,
                         T* background) {
  const RasterArgs<T>& a = b.forward;
  const int active = kF ? kF : slots.active;
  const TileArea area = tile_area(a, tile);
  const int64_t first = area.camera * a.count;
  BlockWalk<T, kGroups> walk;
  walk.reset(area.width, area.height);
  SplatRows<T> rows;
  alignas(32) Pack<T> grad[kF ? kF : kMaxFeatures][kBlocks<T>];
  // What everything from the current splat to the back adds to the loss:
  // g.(blended features + T bg) - g_alpha T, reduced splat by splat.
  alignas(32) Pack<T> behind[kBlocks<T>];
  for_each_block(a, area, [&](int block, int lanes, int64_t pixel) {
    const auto read = [&](const T* in, int step) {
      T lane[kLanes<T>] = {};
      for (int k = 0; k < lanes; ++k) lane[k] = in[k * step];
      return load_pack(lane);
    };
    const Pack<T> alpha = read(a.alpha + pixel, 1), left = T(1) - alpha;
    Pack<T> total{};
    for (int c = 0; c < active; ++c) grad[c][block] = Pack<T>{};
    for (int c = 0; c < a.channels && b.grad_image; ++c) {
      const Pack<T> g = read(b.grad_image + pixel * a.channels + c, a.channels);
      grad[c][block] = g;
      total += g * read(a.image + pixel * a.channels + c, a.channels);
      if (background) background[c] += pack_sum<T>(g * left);
    }
    for (int c = 0; c < a.vectors && b.grad_normal; ++c) {
      const Pack<T> g = read(b.grad_normal + a.vectors * pixel + c, a.vectors);
      grad[a.channels + c][block] = g;
      total += g * read(a.normal + a.vectors * pixel + c, a.vectors);
    }
    Pack<T> grad_alpha = b.grad_alpha ? read(b.grad_alpha + pixel, 1) : Pack<T>{};
    if (b.grad_depth) {
      const Pack<T> g = read(b.grad_depth + pixel, 1), depth = read(a.depth + pixel, 1);
      const auto covered = alpha > T(0);
      const Pack<T> share = covered ? g / alpha : Pack<T>{};
      grad[active - 1][block] = share;
      grad_alpha -= share * depth;
      total += covered ? g * depth : Pack<T>{};
    }
    behind[block] = total - grad_alpha * left;
  });

  constexpr int kFixed = kGradFeatures + (kAbsolute ? 2 : 0);
  // Sums of the instance at hand, in whole packs: moments, features, absolute values.
  constexpr int kRoom = (kFixed + (kF ? kF : kMaxFeatures) + kLanes<T> - 1) / kLanes<T> * kLanes<T>;
  Pack<T> sums[kRoom] = {};
  const int32_t end = a.tile_start[tile + 1];
  int32_t e = a.tile_start[tile];
  for (; e < end && walk.alive; ++e) {
    prefetch_instance(a, a.order, e, end);
    const int32_t s = a.instances[e];
    const T* splat = a.splats + int64_t(s) * a.stride;
    int group = -1;
    if constexpr (kGroups) group = a.groups[s - first];
    const int64_t place = instance_slot(a, s, area);
    if (place < 0) {
      *slots.unsound = true;
      return;
    }
    T* row = slots.row(place);
    const uint64_t reached = rows.place(splat, T(area.x), T(area.y)) & walk.alive;
    if (!reached) {
      std::fill_n(row, slots.width, T(0));
      continue;
    }
    for (int k = 0; k < kFixed + active; ++k) sums[k] = Pack<T>{};
    Pack<T>*moment = sums, *feature = sums + kGradFeatures, *absolute = feature + active;
    const T x = T(2 / kLog2E) * splat[kAcross], y = T(2 / kLog2E) * splat[kDown];
    for (uint64_t bits = reached; bits; bits &= bits - 1) {
      const int block = __builtin_ctzll(bits);
      const auto w = walk.weigh(splat, rows, group, block);
      const T down = rows.down[block % kTileEdge];
      Pack<T> along{};
      for (int f = 0; f < active; ++f) {
        along += grad[f][block] * splat[kFeatures + f];
        feature[f] += w.weight * grad[f][block];
      }
      const Pack<T> rest = behind[block] - w.weight * along;
      behind[block] = rest;
      const Pack<T> v = w.open ? w.weight * along - w.alpha * rest / (T(1) - w.alpha) : Pack<T>{};
      const Pack<T> vx = v * w.across, vy = v * down;
      moment[0] += vx;
      moment[1] += vy;
      moment[2] += vx * w.across;
      moment[3] += vx * down;
      moment[4] += vy * down;
      moment[5] += v;
      if constexpr (kAbsolute) {
        absolute[0] += pack_abs<T>(x * vx);
        absolute[1] += pack_abs<T>(y * vy - splat[kSlope] * x * vx);
      }
    }
    alignas(32) T out[kRoom];
    for (int k = 0; k < kFixed + active; k += kLanes<T>)
      store_pack(out + k, pack_sums<T>(sums + k));
    std::copy_n(out, kFixed + active, row);
  }
  for (; e < end; ++e) {
    const int64_t place = instance_slot(a, a.instances[e], area);
    if (place < 0) {
      *slots.unsound = true;
      return;
    }
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
  clear(b.grad_normals, a.vectors);
}

// Gradients of scales and quaternions from those of covariances; what leaves T's range although
// that did not is zero.
template <typename T>
void store_axes_gradients(const RasterGradArgs<T>& b, const PacketRows<T>& rows, uint32_t any,
                          const Mat3<cpu::Pack<T>>& covariance) {
  using P = cpu::Pack<T>;
  P quat[4], scales[3], grad_scales[3], grad_quat[4], all(0), given(0);
  rows.template columns<4>(b.forward.quats, quat);
  rows.template columns<3>(b.forward.scales, scales);
  Mat3<P> axes;
  auto good = rotation_from_quat(quat, &axes);
  splat_axes_backward(axes, scales, quat, covariance, grad_scales, grad_quat);
  for (const P& g : grad_scales) all += g;
  for (const P& g : grad_quat) all += g;
  for (const P& g : covariance.m) given += g;
  good &= finite(all) | (finite(given) == typename P::Int{});
  const uint32_t kept = any & cpu::mask_bits(good);
  for (int lane = 0; lane < rows.used; ++lane) {
    if (!(kept >> lane & 1)) continue;
    const int64_t i = rows.first + lane;
    for (int k = 0; k < 3; ++k) b.grad_scales[3 * i + k] = grad_scales[k][lane];
    for (int k = 0; k < 4; ++k) b.grad_quats[4 * i + k] = grad_quat[k][lane];
  }
}

// Sums the rows of a packet of Gaussians camera by camera, turns moments into gradients of the
// projected splats and takes those to the inputs.
template <typename T>
void packet_backward(const RasterGradArgs<T>& b, const std::vector<SplatCamera<T>>& cameras,
                     const PacketRows<T>& rows, const GradSlots<T>& slots) {
  using P = cpu::Pack<T>;
  constexpr int kLanes = kPacket<T>, kMost = kGradFeatures + kMaxFeatures + 2;
  const RasterArgs<T>& a = b.forward;
  for (int lane = 0; lane < rows.used; ++lane) clear_gradient(b, rows.first + lane);
  GaussianGradient<P> total;
  uint32_t any = 0;
  for (int camera = 0; camera < a.cameras; ++camera) {
    T sum[kLanes][kMost];
    uint32_t seen = 0;
    for (int lane = 0; lane < rows.used; ++lane) {
      const int64_t s = camera * a.count + rows.first + lane;
      const int64_t begin = a.order[s],
                    end = s + 1 < a.splat_count() ? int64_t(a.order[s + 1]) : a.instance_count;
      std::fill_n(sum[lane], slots.width, T(0));
      for (int64_t slot = begin; slot < end; ++slot)
        for (int k = 0; k < slots.width; ++k) sum[lane][k] += slots.row(slot)[k];
      bool some = false;
      for (int k = 0; k < slots.width; ++k) some = some || sum[lane][k] != T(0);
      seen |= static_cast<uint32_t>(some) << lane;
      if (b.grad_absolute) std::copy_n(sum[lane] + slots.width - 2, 2, b.grad_absolute + 2 * s);
      if (b.grad_offset) std::fill_n(b.grad_offset + 2 * s, 2, T(0));
    }
    if (!seen) continue;
    any |= seen;
    const auto of = [&](const auto& f) {
      return cpu::pack_of<T>([&](int lane) { return seen >> lane & 1 ? f(lane) : T(0); });
    };
    const int64_t first = camera * a.count + rows.first;
    const auto header = [&](int field) {
      return of([&](int lane) { return a.splats[(first + lane) * a.stride + field]; });
    };
    P moment[kGradFeatures], g[kGradFeatures];
    for (int k = 0; k < kGradFeatures; ++k) moment[k] = of([&](int lane) { return sum[lane][k]; });
    const SplatConic<P> conic{header(kAcross), header(kSlope), header(kDown)};
    const P opacity =
        of([&](int lane) { return std::exp2(a.splats[(first + lane) * a.stride + kLogOpacity]); });
    moments_to_gradient(moment, conic, opacity, g);
    if (b.grad_offset)
      for (int lane = 0; lane < rows.used; ++lane)
        if (seen >> lane & 1)
          for (int k = 0; k < 2; ++k) b.grad_offset[2 * (first + lane) + k] = g[k][lane];
    const P depth = b.grad_depth
                        ? of([&](int lane) { return sum[lane][kGradFeatures + slots.active - 1]; })
                        : P(0);
    P mean[3], scales[3], quat[4];
    rows.template columns<3>(a.means, mean);
    SplatShape<P> shape{};
    auto wanted = of([](int) { return T(1); }) > P(0);
    if (a.covars) {
      P c[6];
      for (int k = 0; k < 6; ++k)
        c[k] = cpu::pack_of<T>([&](int lane) { return a.covars[6 * rows.row(lane) + k]; });
      shape.covariance = {c[0], c[1], c[2], c[3], c[4], c[5]};
    } else {
      rows.template columns<4>(a.quats, quat);
      rows.template columns<3>(a.scales, scales);
      wanted &= rotation_from_quat(quat, &shape.axes);
      shape.scales = scales;
    }
    geometry_gradient(packed(cameras[camera]), Vec3<P>{mean[0], mean[1], mean[2]}, shape,
                      rows.column(a.opacities), a.antialiased, g, depth, wanted, &total);
    for (int lane = 0; lane < rows.used; ++lane) {
      if (!(seen >> lane & 1)) continue;
      const int64_t i = rows.first + lane;
      T* feature = sum[lane] + kGradFeatures;
      if (a.sh) {
        const int64_t at = 3 * sh_coefficients(a.sh_degree) * i;
        Vec3<T> part{T(0), T(0), T(0)};
        if (slots.active >= 3)
          sh_backward(a.sh_degree, cameras[camera], load_vec3(a.means + 3 * i), a.sh + at, feature,
                      b.grad_sh + at, &part);
        for (int k = 0; k < 3; ++k) total.mean[k].v[lane] += part[k];
      } else {
        for (int c = 0; c < std::min(a.channels, slots.active); ++c)
          b.grad_colors[a.channels * i + c] += feature[c];
      }
      if (slots.active >= a.channels + a.vectors)
        for (int k = 0; k < a.vectors; ++k)
          b.grad_normals[a.vectors * i + k] += feature[a.channels + k];
    }
  }
  if (!any) return;
  for (int lane = 0; lane < rows.used; ++lane) {
    if (!(any >> lane & 1)) continue;
    const int64_t i = rows.first + lane;
    for (int k = 0; k < 3; ++k) b.grad_means[3 * i + k] = total.mean[k][lane];
    b.grad_opacities[i] = total.opacity[lane];
    // The six numbers stand for the full symmetric matrix: off-diagonal entries count twice.
    constexpr int kEntry[6] = {0, 4, 8, 1, 2, 5};
    for (int k = 0; k < 6 && a.covars; ++k)
      b.grad_covars[6 * i + k] = T(k < 3 ? 1 : 2) * total.covariance.m[kEntry[k]][lane];
  }
  if (!a.covars) store_axes_gradients(b, rows, any, total.covariance);
}

}  // namespace gsf::raster_cpu
