// Adjoint of the blend on CUDA. A warp sums what its 64 pixels say of a splat by exchanging halves
// (14 shuffles for nine numbers, not 45) and adds the sums with one instruction.
#include "cuda/raster/launch.h"
#include "cuda/raster/walk.h"

namespace gsf::cuda {
namespace {

// Branch-free: a division inside a condition would split the warp.
__device__ __forceinline__ float reciprocal(float x) {
  float y;
  asm volatile("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}
__device__ __forceinline__ double reciprocal(double x) { return 1.0 / x; }

// Exchanges halves: of 2 kHalf numbers a lane keeps the sum of one half with its partner's.
template <int kHalf, int kOffset, typename T>
__device__ __forceinline__ void exchange(T* v) {
  const bool upper = threadIdx.x & kOffset;
#pragma unroll
  for (int k = 0; k < kHalf; ++k) {
    const T keep = upper ? v[k + kHalf] : v[k], give = upper ? v[k] : v[k + kHalf];
    v[k] = keep + __shfl_xor_sync(kAllLanes, give, kOffset);
  }
}
template <int kOffset, typename T>
__device__ __forceinline__ T summed_below(T v) {
#pragma unroll
  for (int offset = kOffset; offset > 0; offset /= 2) v += __shfl_xor_sync(kAllLanes, v, offset);
  return v;
}

// Sums over the warp: lane l returns the total of v[l / 4] (eight numbers), of v[l / 8] (four) or
// of v[0]. Spoils v.
template <typename T>
__device__ __forceinline__ T sum_eight(T* v) {
  exchange<4, 16>(v);
  exchange<2, 8>(v);
  exchange<1, 4>(v);
  return summed_below<2>(v[0]);
}
template <typename T>
__device__ __forceinline__ T sum_four(T* v) {
  exchange<2, 16>(v);
  exchange<1, 8>(v);
  return summed_below<4>(v[0]);
}

// Adds a splat's numbers, summed over the warp: eights, then a four or a one, so that a lane ends
// up with one word, and one instruction adds them all. kCount: words there are room for.
template <int kCount, typename T>
class SumAdder {
 public:
  __device__ __forceinline__ explicit SumAdder(const SplatSums<T>& sums) {
    const int lane = threadIdx.x % 32;
    int word = lane % 4 == 0 ? lane / 4 : -1;
    // The rest rides along with the first eight, on lanes that those leave free.
    if (kRest == 1 && lane == 1) word = kFirst;
    if (kRest > 1 && lane % 8 == 1) word = kFirst + lane / 8;
    target_ = word >= 0 && word < sums.width() ? sums.word(word, 0) : nullptr;
    stride_ = sums.stride_of(word);
    width_ = sums.width();
  }

  __device__ __forceinline__ void add(const T* value, int64_t id) const {
    const int lane = threadIdx.x % 32;
#pragma unroll
    for (int e = 1; e < kEights; ++e) {  // more than twelve words stand in one array
      if (8 * e >= width_) break;
      const T total = eight(value, 8 * e);
      if (lane % 4 == 0 && 8 * e + lane / 4 < width_)
        add_global(target_ + id * stride_ + 8 * e, total);
    }
    T total = eight(value, 0);
    if constexpr (kRest == 1) {
      const T last = summed_below<16>(value[kFirst]);
      if (lane == 1) total = last;
    } else if constexpr (kRest > 1) {
      T v[4];
#pragma unroll
      for (int k = 0; k < 4; ++k) v[k] = k < kRest ? value[kFirst + (k < kRest ? k : 0)] : T(0);
      const T last = sum_four(v);
      if (lane % 8 == 1) total = last;
    }
    if (target_) add_global(target_ + id * stride_, total);
  }

 private:
  static constexpr int kEights = kCount <= 4 ? 1 : (kCount + 3) / 8;  // a rest of four is no eight
  static constexpr int kFirst = 8 * kEights;
  static constexpr int kRest = kCount > kFirst ? kCount - kFirst : 0;
  static_assert(kRest <= 4);

  __device__ __forceinline__ static T eight(const T* value, int first) {
    T v[8];
#pragma unroll
    for (int k = 0; k < 8; ++k) v[k] = first + k < kCount ? value[first + k] : T(0);
    return sum_eight(v);
  }

  // Said to the compiler, which else allows for shared memory with a loop.
  __device__ __forceinline__ static void add_global(T* address, T value) {
    __builtin_assume(__isGlobal(address));
    atomicAdd(address, value);
  }

  T* target_;  // word of this lane of splat 0, or null
  int stride_, width_;
};

template <typename T, int kF, bool kGroups, bool kAbsolute>
__global__ void __launch_bounds__(kBlockThreads)
    blend_backward_kernel(RasterGradArgs<T> b, SplatSums<T> sums) {
  __shared__ StagedSplat<T, kF> stage[kBlockWarps][32];
  const RasterArgs<T>& a = b.forward;
  const int active = sums.active;
  const SumAdder<kGradFeatures + (kAbsolute ? 2 : 0) + kF, T> adder(sums);
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
        } else if (f < a.channels + a.vectors) {
          if (b.grad_normal) {
            g = b.grad_normal[a.vectors * pixel + f - a.channels];
            value = a.normal[a.vectors * pixel + f - a.channels];
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
      a, place, active, stage[threadIdx.x / 32],
      [&] { return walk[0].stopped() && walk[1].stopped(); },
      [&](const StagedSplat<T, kF>& s) {
        const T along = s.across * (px - s.x);
        T moment[kGradFeatures] = {}, absolute[2] = {}, feature[kF] = {};
        bool any = false;
#pragma unroll
        for (int p = 0; p < kLanePixels; ++p) {
          const auto w = walk[p].weigh(s, along, T(place.lane_y + p * kLaneRows) + T(0.5));
          any = any || w.keep;
          T toward = T(0);
#pragma unroll
          for (int f = 0; f < kF; ++f) {
            toward += grad[p][f] * s.feature[f];
            feature[f] += w.weight * grad[p][f];
          }
          behind[p] -= w.weight * toward;
          const T all = w.weight * toward - w.alpha * behind[p] * reciprocal(T(1) - w.alpha);
          const T v = w.open ? all : T(0);
          const T vx = v * w.across, vy = v * w.down;
          moment[0] += vx;
          moment[1] += vy;
          moment[2] += vx * w.across;
          moment[3] += vx * w.down;
          moment[4] += vy * w.down;
          moment[5] += v;
          if constexpr (kAbsolute) {
            // As moments_to_gradient has the centre's, pixel by pixel.
            absolute[0] += T(2 / kLog2E) * fabs(s.across * vx);
            absolute[1] += T(2 / kLog2E) * fabs(s.down * vy - s.skew * vx);
          }
        }
        if (!__any_sync(kAllLanes, any)) return;
        constexpr int kFirst = kGradFeatures + (kAbsolute ? 2 : 0);
        T value[kFirst + kF];
#pragma unroll
        for (int k = 0; k < kFirst + kF; ++k)
          value[k] = k < kGradFeatures ? moment[k < kGradFeatures ? k : 0]
                     : k < kFirst      ? absolute[k < kFirst ? k - kGradFeatures : 0]
                                       : feature[k < kFirst ? 0 : k - kFirst];
        adder.add(value, s.id);
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

}  // namespace

template <typename T>
SplatSums<T> raster_sums(const RasterGradArgs<T>& b, T* own) {
  const RasterArgs<T>& a = b.forward;
  SplatSums<T> s{};
  // Features are colours, normal, depth: those behind the last wanted one are left out.
  s.active = b.grad_depth ? a.features : a.channels + (b.grad_normal ? a.vectors : 0);
  s.features = kGradFeatures + (b.grad_absolute ? 2 : 0);
  const int room = a.covars ? 3 + 6 + 1 : 3 + 4 + 3;
  // Up to four features are added in one round, in which every lane knows its word's place.
  if (sizeof(T) == sizeof(float) && a.cameras == 1 && s.active <= 4 && s.width() <= room) {
    s.part[0] = b.grad_means, s.stride[0] = 3, s.end[0] = 3;
    s.part[1] = a.covars ? b.grad_covars : b.grad_quats;
    s.stride[1] = a.covars ? 6 : 4, s.end[1] = 3 + s.stride[1];
    s.part[2] = a.covars ? b.grad_opacities : b.grad_scales;
    s.stride[2] = a.covars ? 1 : 3, s.end[2] = room;
  } else {
    const int stride = (s.width() + 3) / 4 * 4;
    for (int p = 0; p < SplatSums<T>::kParts; ++p)
      s.part[p] = own, s.stride[p] = stride, s.end[p] = stride;
  }
  return s;
}

template <typename T>
int64_t raster_sums_size(const RasterGradArgs<T>& b) {
  const SplatSums<T> s = raster_sums<T>(b, nullptr);
  return s.part[0] ? 0 : b.forward.splat_count() * s.stride[0];
}

template <typename T>
cudaError_t raster_backward(const RasterGradArgs<T>& b, const SplatSums<T>& sums,
                            cudaStream_t stream) {
  const RasterArgs<T>& a = b.forward;
  if (b.grad_background && b.grad_image)
    background_kernel<T><<<dim3(264, a.cameras), 256, 0, stream>>>(b);
  if (a.count == 0) return cudaGetLastError();
  for (int p = 0; p < SplatSums<T>::kParts; ++p) {
    if (p > 0 && sums.part[p] == sums.part[p - 1]) break;  // one array for all
    const size_t bytes = sizeof(T) * static_cast<size_t>(a.splat_count() * sums.stride[p]);
    const cudaError_t error = cudaMemsetAsync(sums.part[p], 0, bytes, stream);
    if (error != cudaSuccess) return error;
  }
  const cudaError_t error =
      with_variant<T>(sums.active, a.groups != nullptr, [&]<int kF, bool kGroups>() {
        if (b.grad_absolute)
          blend_backward_kernel<T, kF, kGroups, true>
              <<<blend_blocks(a), kBlockThreads, 0, stream>>>(b, sums);
        else
          blend_backward_kernel<T, kF, kGroups, false>
              <<<blend_blocks(a), kBlockThreads, 0, stream>>>(b, sums);
        return cudaGetLastError();
      });
  return error == cudaSuccess ? raster_gaussian_backward(b, sums, stream) : error;
}

template SplatSums<float> raster_sums(const RasterGradArgs<float>&, float*);
template SplatSums<double> raster_sums(const RasterGradArgs<double>&, double*);
template int64_t raster_sums_size(const RasterGradArgs<float>&);
template int64_t raster_sums_size(const RasterGradArgs<double>&);
template cudaError_t raster_backward<float>(const RasterGradArgs<float>&, const SplatSums<float>&,
                                            cudaStream_t);
template cudaError_t raster_backward<double>(const RasterGradArgs<double>&,
                                             const SplatSums<double>&, cudaStream_t);

}  // namespace gsf::cuda
