// Forward blend on CUDA: one block per 16x16 tile, one thread per pixel, warps of 8x4 pixels.
#include "cuda/launch_raster.h"
#include "cuda/raster_tile.h"

namespace gsf::cuda {
namespace {

template <typename T, int kF>
__global__ void __launch_bounds__(kTileThreads) blend_kernel(RasterArgs<T> a) {
  __shared__ Stage<T, kF> stage;
  const int features = kF ? kF : a.features;
  const PixelPlace place = pixel_place(a, blockIdx.x);
  const T px = T(place.x) + T(0.5), py = T(place.y) + T(0.5);
  PixelWalk<T> walk(place.inside);
  T sum[kF ? kF : kMaxFeatures];
  for (int f = 0; f < features; ++f) sum[f] = T(0);
  T alpha = T(0);  // sum of weights: 1 - transmittance would cost thin pixels their precision
  for_each_splat(a, blockIdx.x, place, walk, stage, [&](const T* splat, int32_t id, int32_t group) {
    const auto w = walk.weigh(splat, group, px, py);
    if (w.keep) {
      for (int f = 0; f < features; ++f) sum[f] += w.weight * splat[kFeatures + f];
      alpha += w.weight;
    }
    if (a.contribution && __any_sync(kAllLanes, w.keep)) {
      const T total = warp_sum(w.weight);
      if (threadIdx.x % 32 == 0) atomicAdd(a.contribution + id, total);
    }
  });
  if (!place.inside) return;
  const int64_t pixel = int64_t(place.y) * a.width + place.x;
  alpha = min(alpha, T(1));
  a.alpha[pixel] = alpha;
  // Constant indices keep `sum` in registers.
#pragma unroll
  for (int f = 0; f < (kF ? kF : kMaxFeatures); ++f) {
    if (f < a.channels)
      a.image[pixel * a.channels + f] =
          sum[f] + (a.background ? walk.left * a.background[f] : T(0));
    else if (f < features - 1)
      a.normal[3 * pixel + f - a.channels] = sum[f];
    else if (f == features - 1)
      a.depth[pixel] = alpha > T(0) ? sum[f] / alpha : T(0);
  }
}

}  // namespace

template <typename T>
cudaError_t raster_blend(const RasterArgs<T>& a, cudaStream_t stream) {
  return with_features<T>(a.features, [&]<int kF>() {
    blend_kernel<T, kF><<<a.tiles_x * a.tiles_y, kTileThreads, 0, stream>>>(a);
    return cudaGetLastError();
  });
}

template cudaError_t raster_blend<float>(const RasterArgs<float>&, cudaStream_t);
template cudaError_t raster_blend<double>(const RasterArgs<double>&, cudaStream_t);

}  // namespace gsf::cuda
