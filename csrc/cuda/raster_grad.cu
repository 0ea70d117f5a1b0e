// Adjoint of the blend on CUDA: per pixel, summed over the warp, one atomic per warp and value;
// then one thread per Gaussian takes the sums to the inputs.
#include "cuda/launch_raster.h"
#include "cuda/raster_tile.h"

namespace gsf::cuda {
namespace {

template <typename T, int kF>
__global__ void __launch_bounds__(kTileThreads)
    blend_backward_kernel(RasterGradArgs<T> b, int active, T* splat_grads) {
  __shared__ Stage<T, kF> stage;
  const RasterArgs<T>& a = b.forward;
  // Only the first `active` features carry a gradient; rows of splat_grads have room for all.
  const int features = kF ? kF : active, width = kGradFeatures + a.features;
  const int lane = threadIdx.x % 32;
  const PixelPlace place = pixel_place(a, blockIdx.x);
  const T px = T(place.x) + T(0.5), py = T(place.y) + T(0.5);
  const int64_t pixel = int64_t(place.y) * a.width + place.x;

  T grad[kF ? kF : kMaxFeatures];
  for (int f = 0; f < features; ++f) grad[f] = T(0);
  // What everything from the current splat to the back adds to the loss, see the CPU's tile.
  T behind = T(0), left = T(0);
  if (place.inside) {
    const T alpha = a.alpha[pixel];
    left = T(1) - alpha;
    for (int c = 0; c < a.channels && b.grad_image; ++c) {
      grad[c] = b.grad_image[pixel * a.channels + c];
      behind += grad[c] * a.image[pixel * a.channels + c];
    }
    for (int c = 0; c < 3 && b.grad_normal; ++c) {
      grad[a.channels + c] = b.grad_normal[3 * pixel + c];
      behind += grad[a.channels + c] * a.normal[3 * pixel + c];
    }
    T grad_alpha = b.grad_alpha ? b.grad_alpha[pixel] : T(0);
    if (b.grad_depth && alpha > T(0)) {
      const T g = b.grad_depth[pixel];
      grad[features - 1] = g / alpha;
      grad_alpha -= g * a.depth[pixel] / alpha;
      behind += g * a.depth[pixel];
    }
    behind -= grad_alpha * left;
  }
  if (b.grad_background) {
    for (int c = 0; c < a.channels; ++c) {
      const T share = warp_sum(grad[c] * left);
      if (lane == 0) atomicAdd(b.grad_background + c, share);
    }
  }

  PixelWalk<T> walk(place.inside);
  for_each_splat(a, blockIdx.x, place, walk, stage, [&](const T* splat, int32_t id, int32_t group) {
    const auto w = walk.weigh(splat, group, px, py);
    if (!__any_sync(kAllLanes, w.keep)) return;
    T v = T(0);
    if (w.keep) {
      T along = T(0);
      for (int f = 0; f < features; ++f) along += grad[f] * splat[kFeatures + f];
      behind -= w.weight * along;
      if (w.open) v = w.weight * along - w.alpha * behind / (T(1) - w.alpha);
    }
    T* out = splat_grads + int64_t(id) * width;
    const T vx = v * w.dx, vy = v * w.dy;
    const T moments[kGradFeatures] = {vx, vy, vx * w.dx, vx * w.dy, vy * w.dy, v};
    for (int k = 0; k < kGradFeatures; ++k) {
      const T total = warp_sum(moments[k]);
      if (lane == 0) atomicAdd(out + k, total);
    }
    for (int f = 0; f < features; ++f) {
      const T total = warp_sum(w.weight * grad[f]);
      if (lane == 0) atomicAdd(out + kGradFeatures + f, total);
    }
  });
}

template <typename T>
__global__ void splat_backward_kernel(RasterGradArgs<T> b, T* splat_grads) {
  const RasterArgs<T>& a = b.forward;
  const int64_t i = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i >= a.count) return;
  const T* row = a.splats + i * a.stride;
  if (!(row[kOpacity] > T(0))) return;
  // Moments of v -> gradients of centre, conic and opacity; the features stand as they are.
  T* g = splat_grads + i * (kGradFeatures + a.features);
  const T x = g[0], y = g[1];
  g[0] = row[kConicA] * x + row[kConicB] * y;
  g[1] = row[kConicB] * x + row[kConicC] * y;
  g[2] *= T(-0.5);
  g[3] = -g[3];
  g[4] *= T(-0.5);
  g[5] /= row[kOpacity];
  project_splat_backward(b, raster_camera(a), i, g);
}

}  // namespace

template <typename T>
cudaError_t raster_backward(const RasterGradArgs<T>& b, T* splat_grads, cudaStream_t stream) {
  const RasterArgs<T>& a = b.forward;
  // Features are colours, normal, depth: those behind the last wanted one are left out.
  const int active = b.grad_depth ? a.features : a.channels + (b.grad_normal ? 3 : 0);
  const cudaError_t error = with_features<T>(active, [&]<int kF>() {
    blend_backward_kernel<T, kF>
        <<<a.tiles_x * a.tiles_y, kTileThreads, 0, stream>>>(b, active, splat_grads);
    return cudaGetLastError();
  });
  if (error != cudaSuccess || a.count == 0) return error;
  constexpr int kThreads = 128;
  splat_backward_kernel<T>
      <<<static_cast<int>((a.count + kThreads - 1) / kThreads), kThreads, 0, stream>>>(b,
                                                                                       splat_grads);
  return cudaGetLastError();
}

template cudaError_t raster_backward<float>(const RasterGradArgs<float>&, float*, cudaStream_t);
template cudaError_t raster_backward<double>(const RasterGradArgs<double>&, double*, cudaStream_t);

}  // namespace gsf::cuda
