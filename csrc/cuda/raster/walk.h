// What the blend kernel and its adjoint share on CUDA. The unit is a warp with 8x8 pixels, two to a
// lane: it goes through its list tile's splats front to back, 32 at a time, keeps those that reach
// its pixels (a rectangle test), and weighs them. Warps share no state, so none waits for another.
// Both directions walk the same way, so that thresholds, early stops and sibling skips agree.
#pragma once

#include "cuda/raster/layout.h"

namespace gsf::cuda {

constexpr unsigned kAllLanes = 0xffffffffu;
constexpr int kWarpEdge = 8;    // pixels of a warp: 8x8
constexpr int kLanePixels = 2;  // rows y and y + 4
constexpr int kLaneRows = 4;
constexpr int kBlockWarps = 4;  // a block draws 16x16 pixels
constexpr int kBlockEdge = 16;
constexpr int kBlockThreads = 32 * kBlockWarps;
constexpr double kLog2Of255 = 7.994353436858858;

__device__ __forceinline__ float exp2_of(float x) {
  float y;
  asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}
__device__ __forceinline__ double exp2_of(double x) { return exp2(x); }
__device__ __forceinline__ float log2_of(float x) { return __log2f(x); }
__device__ __forceinline__ double log2_of(double x) { return log2(x); }

// A splat as the pixels of a warp read it: log2 alpha = log_opacity - across^2 - down^2 with
// across = this.across dx - skew dy, down = this.down dy. kF: room for features.
template <typename T, int kF>
struct alignas(16) StagedSplat {
  T x, y, across, skew, down;
  T log_opacity, least;  // base 2; least log2 alpha that still contributes
  int32_t id;
  T feature[kF];
  int32_t group;
};

struct WarpPlace {
  int x, y;  // first pixel of the warp
  int lane_x, lane_y;
  int camera;
  int tile;  // of the lists, all cameras counted
};

template <typename T>
__device__ __forceinline__ WarpPlace warp_place(const RasterArgs<T>& a) {
  const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
  WarpPlace p;
  p.x = blockIdx.x * kBlockEdge + warp % 2 * kWarpEdge;
  p.y = blockIdx.y * kBlockEdge + warp / 2 * kWarpEdge;
  p.lane_x = p.x + lane % kWarpEdge;
  p.lane_y = p.y + lane / kWarpEdge;
  p.camera = blockIdx.z;
  p.tile = p.camera * a.tiles() + p.y / a.tile * a.tiles_x + p.x / a.tile;
  return p;
}

template <typename T>
inline dim3 blend_blocks(const RasterArgs<T>& a) {
  return dim3((a.width + kBlockEdge - 1) / kBlockEdge, (a.height + kBlockEdge - 1) / kBlockEdge,
              a.cameras);
}

// True when the support of the splat (across^2 + down^2 up to `reach`) may reach a pixel centre of
// the warp: the smallest power over the rectangle lies on an edge that faces the centre. A little
// slack absorbs rounding.
template <typename T>
__device__ __forceinline__ bool reaches_warp(const SplatGeometry<T>& g, T reach,
                                             const WarpPlace& p) {
  const T x0 = T(p.x) + T(0.5) - g.x, x1 = x0 + T(kWarpEdge - 1);
  const T y0 = T(p.y) + T(0.5) - g.y, y1 = y0 + T(kWarpEdge - 1);
  const T dx = clamp(T(0), x0, x1), dy = clamp(T(0), y0, y1);  // nearest point to the centre
  if (fabs(dx) > g.extent_x || fabs(dy) > g.extent_y) return false;
  const T limit = reach * T(1.001) + T(1e-4);
  const auto within = [&](T x, T y) {
    const T across = g.conic.across * (x - g.conic.slope * y), down = g.conic.down * y;
    return across * across + down * down <= limit;
  };
  const bool by_x = dx != T(0) && within(dx, clamp(vertical_slope(g) * dx, y0, y1));
  const bool by_y = dy != T(0) && within(clamp(g.conic.slope * dy, x0, x1), dy);
  // Where the centre lies between two edges, those say nothing.
  return by_x || by_y || (dx == T(0) && dy == T(0));
}

// One pixel's way through its splats.
template <typename T, bool kGroups>
struct PixelWalk {
  T left;  // transmittance; negative once the pixel has stopped, so that no later test passes
  int32_t ring[kGroups ? kSiblingRing : 1];

  __device__ __forceinline__ void start(bool inside) {
    left = inside ? T(1) : T(-1);
#pragma unroll
    for (int32_t& slot : ring) slot = -1;
  }
  __device__ __forceinline__ bool stopped() const { return left < T(0); }

  struct Weight {
    T across, down, alpha, weight;
    bool keep, open;  // contributes; contributes and the cap does not bind
  };

  // `along` is the part of `across` that the lane's column gives.
  template <int kF>
  __device__ __forceinline__ Weight weigh(const StagedSplat<T, kF>& s, T along, T py) {
    Weight r;
    const T dy = py - s.y;
    r.across = along - s.skew * dy;
    r.down = s.down * dy;
    const T log_alpha = s.log_opacity - r.down * r.down - r.across * r.across;
    const T raw = exp2_of(log_alpha);
    r.alpha = min(raw, T(kMaxAlpha));
    bool pass = log_alpha >= s.least;
    if constexpr (kGroups) {
      if (s.group >= 0) {
#pragma unroll
        for (int k = 0; k < kSiblingRing; ++k) pass = pass && ring[k] != s.group;
      }
    }
    const T after = left - r.alpha * left;
    r.keep = pass && after > T(kMinTransmittance);
    r.open = r.keep && raw < T(kMaxAlpha);
    r.weight = r.keep ? r.alpha * left : T(0);
    left = r.keep ? after : (pass ? -fabs(left) : left);
    if constexpr (kGroups) {
      if (r.keep && s.group >= 0) {
#pragma unroll
        for (int k = kSiblingRing - 1; k > 0; --k) ring[k] = ring[k - 1];
        ring[0] = s.group;
      }
    }
    return r;
  }
};

// Walks the warp's splats front to back: f(staged splat) is called by the whole warp for those that
// reach it. `stopped()` is asked before every 32 splats whether the lane's pixels have all ended.
template <typename T, int kF, bool kGroups, typename Stopped, typename F>
__device__ __forceinline__ void for_each_splat(const RasterArgs<T>& a, const WarpPlace& place,
                                               int features, StagedSplat<T, kF>* stage,
                                               const Stopped& stopped, const F& f) {
  const int total = static_cast<int>(a.instance_count), lane = threadIdx.x % 32;
  const int begin = clamp(a.tile_start[place.tile], 0, total);
  const int end = clamp(a.tile_start[place.tile + 1], 0, total);
  const int32_t last_id = static_cast<int32_t>(a.splat_count()) - 1;
  const SplatGeometry<T>* geometry = splat_geometry(a);
  const T* feature_rows = splat_feature_rows(a);
  // Clamped: the adjoint is handed these lists back and trusts nothing it reads.
  const auto id_at = [&](int e) { return e < end ? clamp(a.instances[e], 0, last_id) : 0; };
  int32_t id = id_at(begin + lane), next_id = id_at(begin + 32 + lane);
  SplatGeometry<T> g{};
  if (begin + lane < end) g = geometry[id];
  for (int first = begin; first < end; first += 32) {
    if (__all_sync(kAllLanes, stopped())) return;
    // A culled splat is in no list; lists that were tampered with must not make log(0).
    const bool real = first + lane < end && g.opacity > T(0);
    const T log_opacity = real ? log2_of(g.opacity) : T(0);
    const T reach = min(log_opacity + T(kLog2Of255), T(kMaxPower * kLog2E));
    const bool reaches = real && reaches_warp(g, reach, place);
    const unsigned mask = __ballot_sync(kAllLanes, reaches);
    if (reaches) {
      StagedSplat<T, kF>& s = stage[__popc(mask & ((1u << lane) - 1))];
      s.x = g.x;
      s.y = g.y;
      s.across = g.conic.across;
      s.skew = g.conic.across * g.conic.slope;
      s.down = g.conic.down;
      s.log_opacity = log_opacity;
      s.least = log_opacity - reach;
      s.id = id;
      const T* row = feature_rows + int64_t(id) * a.features;
#pragma unroll
      for (int k = 0; k < kF; ++k) s.feature[k] = k < features ? row[k] : T(0);
      if constexpr (kGroups)
        s.group =
            a.groups ? a.groups[a.cameras == 1 ? id : static_cast<int32_t>(id % a.count)] : -1;
    }
    // The next 32 are on their way while these are weighed.
    id = next_id;
    next_id = id_at(first + 64 + lane);
    if (first + 32 + lane < end) g = geometry[id];
    __syncwarp();
    const int count = __popc(mask);
    for (int k = 0; k < count; ++k) f(stage[k]);
    __syncwarp();
  }
}

template <typename T>
__device__ __forceinline__ T warp_sum(T v) {
#pragma unroll
  for (int offset = 16; offset > 0; offset /= 2) v += __shfl_xor_sync(kAllLanes, v, offset);
  return v;
}

// Calls f.operator()<room for features, flag>().
template <typename T, typename F>
cudaError_t with_variant(int features, bool flag, const F& f) {
  const auto choose = [&]<int kF>() {
    return flag ? f.template operator()<kF, true>() : f.template operator()<kF, false>();
  };
  if constexpr (sizeof(T) == sizeof(float)) {
    if (features <= 3) return choose.template operator()<3>();    // rgb
    if (features == 4) return choose.template operator()<4>();    // rgb, depth
    if (features <= 8) return choose.template operator()<8>();    // rgb, normal, depth
    if (features <= 12) return choose.template operator()<12>();  // and what light asks of a splat
  }
  return choose.template operator()<kMaxFeatures>();
}

}  // namespace gsf::cuda
