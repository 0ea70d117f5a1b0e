// Adjoint of the blend on CUDA. A warp sums what its 64 pixels say of a splat by exchanging halves
// (16 shuffles for up to 16 numbers, not 5 each) and adds the sums with one instruction to
// consecutive words.
#include "cuda/launch_raster.h"
#include "cuda/raster_walk.h"

namespace gsf::cuda {
namespace {

constexpr int kLanesSums = 16;  // numbers summed at once

// Exchanges halves: of 2 kHalf numbers a lane keeps the sum of one half with its partner's.
template <typename T, int kHalf>
__device__ __forceinline__ void exchange(T (&v)[kLanesSums]) {
  const bool upper = threadIdx.x & (2 * kHalf);
#pragma unroll
  for (int k = 0; k < kHalf; ++k) {
    const T keep = upper ? v[k + kHalf] : v[k], give = upper ? v[k] : v[k + kHalf];
    v[k] = keep + __shfl_xor_sync(kAllLanes, give, 2 * kHalf);
  }
}

// Sums v[0..15] over the warp; lane l returns the total of v[l / 2].
template <typename T>
__device__ __forceinline__ T sum_sixteen(T (&v)[kLanesSums]) {
  exchange<T, 8>(v);
  exchange<T, 4>(v);
  exchange<T, 2>(v);
  exchange<T, 1>(v);
  return v[0] + __shfl_xor_sync(kAllLanes, v[0], 1);
}

// Adds `count` numbers, summed over the warp, to out[0..count).
template <typename T, int kCount>
__device__ __forceinline__ void add_sums(const T (&value)[kCount], int count, T* out) {
  const int mine = threadIdx.x % 32 / 2;
#pragma unroll
  for (int base = 0; base < kCount; base += kLanesSums) {
    if (base < count) {
      T v[kLanesSums];
#pragma unroll
      for (int k = 0; k < kLanesSums; ++k) v[k] = base + k < kCount ? value[base + k] : T(0);
      const T total = sum_sixteen(v);
      if (threadIdx.x % 2 == 0 && base + mine < count) atomicAdd(out + base + mine, total);
    }
  }
}

template <typename T, int kF, bool kGroups>
__global__ void __launch_bounds__(kBlockThreads)
    blend_backward_kernel(RasterGradArgs<T> b, SplatSums<T> sums) {
  __shared__ StagedSplat<T, kF> stage[kBlockWarps][32];
  const RasterArgs<T>& a = b.forward;
  const int active = sums.active;
  const WarpPlace place = warp_place(a);
  const T px = T(place.lane_x) + T(0.5);

  PixelWalk<T, kGroups> walk[kLanePixels];
  T grad[kLanePixels][kF];
  // What everything from the current splat to the back adds to the loss: g . (blended features +
  // T bg) - g_alpha T, reduced splat by splat.
  T behind[kLanePixels];
#pragma unroll
  for (int p = 0; p < kLanePixels; ++p) {
    const int y = place.lane_y + p * kLaneRows;
    const bool inside = place.lane_x < a.width && y < a.height;
    const int64_t pixel =
        inside ? (int64_t(place.camera) * a.height + y) * a.width + place.lane_x : 0;
    walk[p].start(inside);
    behind[p] = T(0);
    const T alpha = inside ? a.alpha[pixel] : T(0);
    T grad_alpha = inside && b.grad_alpha ? b.grad_alpha[pixel] : T(0);
#pragma unroll
    for (int f = 0; f < kF; ++f) {
      T g = T(0), value = T(0);
      if (inside && f < active) {
        if (f < a.channels) {
          if (b.grad_image) {
            g = b.grad_image[pixel * a.channels + f];
            value = a.image[pixel * a.channels + f];
          }
        } else if (a.has_normals && f < a.channels + 3) {
          if (b.grad_normal) {
            g = b.grad_normal[3 * pixel + f - a.channels];
            value = a.normal[3 * pixel + f - a.channels];
          }
        } else if (b.grad_depth && alpha > T(0)) {
          const T gd = b.grad_depth[pixel];
          grad_alpha -= gd * a.depth[pixel] / alpha;
          g = gd / alpha;
          value = a.depth[pixel] * alpha;
        }
      }
      grad[p][f] = g;
      behind[p] += g * value;
    }
    behind[p] -= grad_alpha * (T(1) - alpha);
  }

  for_each_splat<T, kF, kGroups>(
      a, place, active, stage[threadIdx.x / 32], [&] { return walk[0].stopped && walk[1].stopped; },
      [&](const StagedSplat<T, kF>& s) {
        const T dx = px - s.x, along = s.a * dx * dx, cross = s.b * dx;
        // Moments, features, absolute gradients of the centre, all over the lane's pixels.
        constexpr int kCount = kGradFeatures + kF + 2;
        T value[kCount];
#pragma unroll
        for (int k = 0; k < kCount; ++k) value[k] = T(0);
        bool any = false;
        T absolute_x = T(0), absolute_y = T(0);
#pragma unroll
        for (int p = 0; p < kLanePixels; ++p) {
          const auto w = walk[p].weigh(s, along, cross, T(place.lane_y + p * kLaneRows) + T(0.5));
          any = any || w.keep;
          T toward = T(0);
#pragma unroll
          for (int f = 0; f < kF; ++f) {
            toward += grad[p][f] * s.feature[f];
            value[kGradFeatures + f] += w.weight * grad[p][f];
          }
          behind[p] -= w.weight * toward;
          const T v = w.open ? w.weight * toward - w.alpha * behind[p] / (T(1) - w.alpha) : T(0);
          const T vx = v * dx, vy = v * w.dy;
          value[0] += vx;
          value[1] += vy;
          value[2] += vx * dx;
          value[3] += vx * w.dy;
          value[4] += vy * w.dy;
          value[5] += v;
          if (b.grad_absolute) {
            // s.a is half of the conic's entry, both in base 2.
            absolute_x += fabs(2 * s.a * vx + s.b * vy);
            absolute_y += fabs(s.b * vx + 2 * s.c * vy);
          }
        }
        if (!__any_sync(kAllLanes, any)) return;
        T* out = sums.data + int64_t(s.id) * sums.stride;
        if (b.grad_absolute) {
#pragma unroll
          for (int k = kGradFeatures; k < kCount; ++k) {
            if (k == kGradFeatures + active) value[k] = absolute_x * T(1 / kLog2E);
            if (k == kGradFeatures + active + 1) value[k] = absolute_y * T(1 / kLog2E);
          }
          add_sums(value, kGradFeatures + active + 2, out);
        } else {
          add_sums(value, kGradFeatures + active, out);
        }
      });
}

// Sum of the image's gradient that shines through, per channel: few blocks, few atomics.
template <typename T>
__global__ void background_kernel(RasterGradArgs<T> b) {
  const RasterArgs<T>& a = b.forward;
  const int64_t pixels = int64_t(a.width) * a.height, first = blockIdx.y * pixels;
  __shared__ T block_sum;
  for (int c = 0; c < a.channels; ++c) {
    T sum = T(0);
    for (int64_t k = int64_t(blockIdx.x) * blockDim.x + threadIdx.x; k < pixels;
         k += int64_t(gridDim.x) * blockDim.x)
      sum += b.grad_image[(first + k) * a.channels + c] * (T(1) - a.alpha[first + k]);
    if (threadIdx.x == 0) block_sum = T(0);
    __syncthreads();
    sum = warp_sum(sum);
    if (threadIdx.x % 32 == 0) atomicAdd(&block_sum, sum);
    __syncthreads();
    if (threadIdx.x == 0)
      atomicAdd(b.grad_background + int64_t(blockIdx.y) * a.background_stride + c, block_sum);
    __syncthreads();
  }
}

// Zeroes the words of every splat that hold sums; the rest of a row may be anything.
template <typename T>
__global__ void clear_kernel(SplatSums<T> sums, int width, int64_t splats) {
  const int64_t k = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  if (k < splats * width) sums.data[k / width * sums.stride + k % width] = T(0);
}

}  // namespace

template <typename T>
SplatSums<T> raster_sums(const RasterGradArgs<T>& b) {
  const RasterArgs<T>& a = b.forward;
  // Features are colours, normal, depth: those behind the last wanted one are left out.
  const int active = b.grad_depth ? a.features : a.channels + (b.grad_normal ? 3 : 0);
  const int width = kGradFeatures + active + (b.grad_absolute ? 2 : 0);
  const int room = a.sh ? 3 * sh_coefficients(a.sh_degree) : 0;
  // One camera's sums fit into the rows that their own gradient of `sh` will fill: saves memory.
  if (a.cameras == 1 && room >= width) return {b.grad_sh, room, active};
  return {nullptr, (width + 3) / 4 * 4, active};
}

template <typename T>
cudaError_t raster_backward(const RasterGradArgs<T>& b, const SplatSums<T>& sums,
                            cudaStream_t stream) {
  const RasterArgs<T>& a = b.forward;
  if (b.grad_background && b.grad_image)
    background_kernel<T><<<dim3(264, a.cameras), 256, 0, stream>>>(b);
  if (a.count == 0) return cudaGetLastError();
  const int width = kGradFeatures + sums.active + (b.grad_absolute ? 2 : 0);
  const int64_t words = a.splat_count() * width;
  clear_kernel<T><<<static_cast<unsigned>((words + 255) / 256), 256, 0, stream>>>(sums, width,
                                                                                  a.splat_count());
  const cudaError_t error =
      with_variant<T>(sums.active, a.groups != nullptr, [&]<int kF, bool kGroups>() {
        blend_backward_kernel<T, kF, kGroups>
            <<<blend_blocks(a), kBlockThreads, 0, stream>>>(b, sums);
        return cudaGetLastError();
      });
  return error == cudaSuccess ? raster_gaussian_backward(b, sums, stream) : error;
}

template SplatSums<float> raster_sums(const RasterGradArgs<float>&);
template SplatSums<double> raster_sums(const RasterGradArgs<double>&);
template cudaError_t raster_backward<float>(const RasterGradArgs<float>&, const SplatSums<float>&,
                                            cudaStream_t);
template cudaError_t raster_backward<double>(const RasterGradArgs<double>&,
                                             const SplatSums<double>&, cudaStream_t);

}  // namespace gsf::cuda
