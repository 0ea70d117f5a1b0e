// Forward blend on CUDA.
#include "core/raster/order_free.h"
#include "cuda/raster/launch.h"
#include "cuda/raster/walk.h"

namespace gsf::cuda {
namespace {

// kExtras: sibling groups, contribution or median depth are wanted; without, nothing of them is in
// the loop.
template <typename T, int kF, bool kExtras>
__global__ void __launch_bounds__(kBlockThreads)
    blend_kernel(RasterArgs<T> a, int64_t* units, double per_unit) {
  __shared__ StagedSplat<T, kF> stage[kBlockWarps][32];
  const WarpPlace place = warp_place(a);
  const T px = T(place.lane_x) + T(0.5);
  PixelWalk<T, kExtras> walk[kLanePixels];
  T sum[kLanePixels][kF], alpha[kLanePixels], median[kLanePixels];
#pragma unroll
  for (int p = 0; p < kLanePixels; ++p) {
    walk[p].start(place.lane_x < a.width && place.lane_y + p * kLaneRows < a.height);
    alpha[p] = median[p] = T(0);
#pragma unroll
    for (int f = 0; f < kF; ++f) sum[p][f] = T(0);
  }
  // Camera z of a splat, for the median; at most once a pixel.
  const auto depth_of = [&](int32_t id) {
    const T* row = a.viewmat + 16 * place.camera + 8;
    const T* mean = a.means + 3 * (id - int64_t(place.camera) * a.count);
    return row[0] * mean[0] + row[1] * mean[1] + row[2] * mean[2] + row[3];
  };

  for_each_splat<T, kF, kExtras>(
      a, place, a.features, stage[threadIdx.x / 32],
      [&] { return walk[0].stopped() && walk[1].stopped(); },
      [&](const StagedSplat<T, kF>& s) {
        const T along = s.across * (px - s.x);
        T both = T(0);
#pragma unroll
        for (int p = 0; p < kLanePixels; ++p) {
          const T before = walk[p].left;
          const auto w = walk[p].weigh(s, along, T(place.lane_y + p * kLaneRows) + T(0.5));
#pragma unroll
          for (int f = 0; f < kF; ++f) sum[p][f] += w.weight * s.feature[f];
          // Sum of weights: 1 - transmittance would cost thin pixels their precision.
          alpha[p] += w.weight;
          both += w.weight;
          if constexpr (kExtras) {
            if (a.median && w.keep && before > T(0.5) && walk[p].left <= T(0.5))
              median[p] = depth_of(s.id);
          }
        }
        if constexpr (kExtras) {
          if (a.contribution && __any_sync(kAllLanes, both > T(0))) {
            const T total = warp_sum(both);
            if (threadIdx.x % 32 == 0)
              atomicAdd(reinterpret_cast<unsigned long long*>(
                            units + (s.id - int64_t(place.camera) * a.count)),
                        static_cast<unsigned long long>(__double2ll_rn(double(total) * per_unit)));
          }
        }
      });

#pragma unroll
  for (int p = 0; p < kLanePixels; ++p) {
    const int y = place.lane_y + p * kLaneRows;
    const bool inside = place.lane_x < a.width && y < a.height;
    const int64_t pixel = (int64_t(place.camera) * a.height + y) * a.width + place.lane_x;
    const T covered = min(alpha[p], T(1));
    if (inside) a.alpha[pixel] = covered;
    if (inside && a.median) a.median[pixel] = median[p];
    // Constant indices keep `sum` in registers. Colours alone are the common case.
    const auto color = [&](int f) {
      return sum[p][f] + fabs(walk[p].left) * a.background_color(place.camera, f);
    };
    if (a.features == kF && a.channels == kF) {
#pragma unroll
      for (int f = 0; f < kF; ++f)
        if (inside) a.image[pixel * kF + f] = color(f);
    } else {
#pragma unroll
      for (int f = 0; f < kF; ++f) {
        if (inside && f < a.channels)
          a.image[pixel * a.channels + f] = color(f);
        else if (inside && f < a.channels + a.vectors)
          a.normal[a.vectors * pixel + f - a.channels] = sum[p][f];
        else if (inside && a.has_depth && f == a.features - 1)
          a.depth[pixel] = covered > T(0) ? sum[p][f] / covered : T(0);
      }
    }
  }
}

template <typename T>
__global__ void contribution_kernel(RasterArgs<T> a, const int64_t* units, double per_unit) {
  const int64_t i = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i < a.count) a.contribution[i] = T(double(units[i]) / per_unit);
}

}  // namespace

template <typename T>
cudaError_t raster_blend(const RasterArgs<T>& a, int64_t* units, cudaStream_t stream) {
  const bool extras = a.groups || a.contribution || a.median;
  // A pixel gives a Gaussian a weight of one at most, so no sum over all pixels can overflow.
  const int64_t pixels = int64_t(a.width) * a.height * a.cameras;
  const double per_unit = double(int64_t(1) << (62 - bits_above(pixels)));
  if (a.contribution && a.count > 0) {
    const size_t bytes = sizeof(int64_t) * static_cast<size_t>(a.count);
    const cudaError_t error = cudaMemsetAsync(units, 0, bytes, stream);
    if (error != cudaSuccess) return error;
  }
  const cudaError_t error = with_variant<T>(a.features, extras, [&]<int kF, bool kExtras>() {
    blend_kernel<T, kF, kExtras><<<blend_blocks(a), kBlockThreads, 0, stream>>>(a, units, per_unit);
    return cudaGetLastError();
  });
  if (error != cudaSuccess || !a.contribution || a.count == 0) return error;
  const auto blocks = static_cast<unsigned>((a.count + 255) / 256);
  contribution_kernel<T><<<blocks, 256, 0, stream>>>(a, units, per_unit);
  return cudaGetLastError();
}

template cudaError_t raster_blend<float>(const RasterArgs<float>&, int64_t*, cudaStream_t);
template cudaError_t raster_blend<double>(const RasterArgs<double>&, int64_t*, cudaStream_t);

}  // namespace gsf::cuda
