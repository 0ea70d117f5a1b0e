// What the blend kernel and its adjoint share on CUDA: the pixel of a thread, the warp's test of a
// splat against its 8x4 pixels, and the weight of a splat at a pixel. Front to back in both, so
// that thresholds, early stops and sibling skips agree.
#pragma once

#include "core/raster.h"

namespace gsf::cuda {

constexpr int kTileThreads = kTile * kTile;
constexpr int kBatch = 128;  // splats staged in shared memory; a multiple of the warp size
constexpr unsigned kAllLanes = 0xffffffffu;
constexpr int kWarpWidth = 8, kWarpHeight = 4;  // pixels of a warp

struct PixelPlace {
  int x, y;            // pixel of this thread
  int warp_x, warp_y;  // first pixel of the warp
  bool inside;
};

template <typename T>
__device__ __forceinline__ PixelPlace pixel_place(const RasterArgs<T>& a, int tile) {
  const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
  PixelPlace p;
  p.warp_x = tile % a.tiles_x * kTile + warp % 2 * kWarpWidth;
  p.warp_y = tile / a.tiles_x * kTile + warp / 2 * kWarpHeight;
  p.x = p.warp_x + lane % kWarpWidth;
  p.y = p.warp_y + lane / kWarpWidth;
  p.inside = p.x < a.width && p.y < a.height;
  return p;
}

// True when the support of the splat may reach a pixel centre of the warp: the smallest power over
// the rectangle lies on an edge that faces the centre. A little slack absorbs rounding.
template <typename T>
__device__ __forceinline__ bool reaches_warp(const T* splat, const PixelPlace& p) {
  const T x0 = T(p.warp_x) + T(0.5) - splat[kX], x1 = x0 + T(kWarpWidth - 1);
  const T y0 = T(p.warp_y) + T(0.5) - splat[kY], y1 = y0 + T(kWarpHeight - 1);
  const T dx = clamp(T(0), x0, x1), dy = clamp(T(0), y0, y1);  // nearest point to the centre
  const T a = splat[kConicA], b = splat[kConicB], c = splat[kConicC];
  const T limit = splat[kCutoff] * T(1.001) + T(1e-4);
  if (dx == T(0) && dy == T(0)) return true;
  if (dx != T(0)) {
    const T y = clamp(-b * dx / c, y0, y1);
    if (T(0.5) * (a * dx * dx + c * y * y) + b * dx * y <= limit) return true;
  }
  if (dy != T(0)) {
    const T x = clamp(-b * dy / a, x0, x1);
    if (T(0.5) * (a * x * x + c * dy * dy) + b * x * dy <= limit) return true;
  }
  return false;
}

__device__ __forceinline__ float exponential(float x) { return expf(x); }
__device__ __forceinline__ double exponential(double x) { return exp(x); }

// One pixel's way through its splats.
template <typename T>
struct PixelWalk {
  T left = T(1);  // transmittance
  bool stopped;
  int32_t ring[kSiblingRing];

  __device__ explicit PixelWalk(bool inside) : stopped(!inside) {
#pragma unroll
    for (int k = 0; k < kSiblingRing; ++k) ring[k] = -1;
  }

  struct Weight {
    T dx, dy, alpha, weight;
    bool keep, open;  // contributes; contributes and the cap does not bind
  };

  // `group` is -1 without siblings.
  __device__ __forceinline__ Weight weigh(const T* splat, int32_t group, T px, T py) {
    Weight r{};
    if (stopped) return r;
    r.dx = px - splat[kX];
    r.dy = py - splat[kY];
    const T power = max(r.dx * (T(0.5) * splat[kConicA] * r.dx + splat[kConicB] * r.dy) +
                            T(0.5) * splat[kConicC] * r.dy * r.dy,
                        T(0));
    if (!(power <= splat[kCutoff])) return r;
    if (group >= 0) {
      bool seen = false;
#pragma unroll
      for (int k = 0; k < kSiblingRing; ++k) seen = seen || ring[k] == group;
      if (seen) return r;
    }
    const T raw = splat[kOpacity] * exponential(-power);
    r.alpha = min(raw, T(kMaxAlpha));
    const T after = left - r.alpha * left;
    if (!(after > T(kMinTransmittance))) {
      stopped = true;
      return r;
    }
    r.keep = true;
    r.open = raw < T(kMaxAlpha);
    r.weight = r.alpha * left;
    left = after;
    if (group >= 0) {
#pragma unroll
      for (int k = kSiblingRing - 1; k > 0; --k) ring[k] = ring[k - 1];
      ring[0] = group;
    }
    return r;
  }
};

// Splats staged for one tile. kF: features when known at compile time, else 0.
template <typename T, int kF>
struct Stage {
  static constexpr int kUsed = kFeatures + (kF ? kF : kMaxFeatures);
  T row[kBatch][kUsed];
  int32_t id[kBatch];
  int32_t group[kBatch];

  // All threads of the block load the `count` splats that start at instance `first`.
  __device__ void load(const RasterArgs<T>& a, int first, int count) {
    const int used = kF ? kUsed : kFeatures + a.features;
    for (int k = threadIdx.x; k < count; k += kTileThreads) {
      // Clamped: the adjoint is handed these lists back and trusts nothing it reads.
      id[k] = clamp(a.instances[first + k], 0, static_cast<int32_t>(a.count) - 1);
      group[k] = a.groups ? a.groups[id[k]] : -1;
    }
    __syncthreads();
    for (int k = threadIdx.x; k < count * used; k += kTileThreads)
      row[k / used][k % used] = a.splats[int64_t(id[k / used]) * a.stride + k % used];
    __syncthreads();
  }
};

template <typename T>
__device__ __forceinline__ T warp_sum(T v) {
#pragma unroll
  for (int offset = 16; offset > 0; offset /= 2) v += __shfl_xor_sync(kAllLanes, v, offset);
  return v;
}

// Walks the block's splats front to back: f(staged row, id, group) is called by whole warps for
// the splats that reach them. Ends when every pixel of the tile has stopped.
template <typename T, int kF, typename F>
__device__ void for_each_splat(const RasterArgs<T>& a, int tile, const PixelPlace& place,
                               const PixelWalk<T>& walk, Stage<T, kF>& stage, const F& f) {
  const int total = static_cast<int>(a.instance_count);
  const int begin = clamp(a.tile_start[tile], 0, total);
  const int end = clamp(a.tile_start[tile + 1], 0, total);
  const int lane = threadIdx.x % 32;
  for (int first = begin; first < end; first += kBatch) {
    if (__syncthreads_and(walk.stopped)) return;
    const int count = end - first < kBatch ? end - first : kBatch;
    stage.load(a, first, count);
    for (int chunk = 0; chunk < count; chunk += 32) {
      if (__all_sync(kAllLanes, walk.stopped)) break;
      const int mine = chunk + lane;
      const bool reaches = mine < count && reaches_warp(stage.row[mine], place);
      for (unsigned bits = __ballot_sync(kAllLanes, reaches); bits; bits &= bits - 1) {
        const int k = chunk + __ffs(bits) - 1;
        f(stage.row[k], stage.id[k], stage.group[k]);
      }
    }
  }
}

// Calls f.operator()<kF>() with the compile-time feature count, 0 when only known at run time.
template <typename T, typename F>
cudaError_t with_features(int features, const F& f) {
  if constexpr (sizeof(T) == sizeof(float)) {
    if (features == 3) return f.template operator()<3>();  // rgb (adjoint)
    if (features == 4) return f.template operator()<4>();  // rgb, depth
    if (features == 7) return f.template operator()<7>();  // rgb, normal, depth
  }
  return f.template operator()<0>();
}

}  // namespace gsf::cuda
