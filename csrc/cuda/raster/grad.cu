// Adjoint of the blend on CUDA. A warp sums what its 64 pixels say of a splat by exchanging halves
// (14 shuffles for nine numbers, not 45) and adds the sums with one instruction: floats, whose last
// bits then depend on the order of the warps, or, when asked, whole numbers (core/raster/
// order_free.h), which takes two instructions at most, a bound found before and a rounding after.
#include "core/raster/order_free.h"
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

// Units of the order-free sums. An addend is the sum of what 64 pixels say of a splat, at most 102
// (S F + B) each for v, where S is the largest sum of a pixel's |gradients|, B its largest |behind|
// and F the largest |feature|: |v| <= S F + a / (1 - a) (B + S F), a <= 0.99. Moments are 8 times v
// at most (across^2 + down^2 <= 8 in the support), absolute gradients 13 times (the low-pass holds
// across and down below 1.6 per pixel), and features are S. 2^18 and 2^7 cover that and rounding.
template <typename T>
__device__ OrderFreeUnits units_of(const RasterArgs<T>& a, const SplatSums<T>& sums) {
  const double* bound = reinterpret_cast<const double*>(sums.fixed);
  const int64_t warps = (int64_t(a.width) / kWarpEdge + 2) * (int64_t(a.height) / kWarpEdge + 2);
  return OrderFreeUnits::of(262144.0 * (bound[0] * bound[2] + bound[1]) + 128.0 * bound[0], warps);
}

// Gradients of what a pixel blends. Returns what everything from the first splat to the back adds
// to the loss: g . (blended features + T bg) - g_alpha T.
template <typename T, int kF>
__device__ __forceinline__ T pixel_gradient(const RasterGradArgs<T>& b, int active, int64_t pixel,
                                            bool inside, T (&grad)[kF]) {
  const RasterArgs<T>& a = b.forward;
  T behind = T(0);
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
    grad[f] = g;
    behind += g * value;
  }
  return behind - grad_alpha * (T(1) - alpha);
}

constexpr int kBoundThreads = 256, kBoundBlocks = 528;

// Largest S, B, F of units_of. What is not finite is left out: its addends mark their sums.
template <typename T, int kF>
__global__ void __launch_bounds__(kBoundThreads)
    bounds_kernel(RasterGradArgs<T> b, SplatSums<T> sums) {
  const RasterArgs<T>& a = b.forward;
  const int64_t first = int64_t(blockIdx.x) * kBoundThreads + threadIdx.x;
  const int64_t step = int64_t(gridDim.x) * kBoundThreads;
  double largest[3] = {};
  const auto raise = [&](int k, double value) {
    if (value > largest[k] && value <= 1.7e308) largest[k] = value;
  };
  const int64_t pixels = int64_t(a.cameras) * a.width * a.height;
  for (int64_t pixel = first; pixel < pixels; pixel += step) {
    T grad[kF];
    raise(1, fabs(double(pixel_gradient<T, kF>(b, sums.active, pixel, true, grad))));
    double sum = 0.0;
#pragma unroll
    for (int f = 0; f < kF; ++f) sum += fabs(double(grad[f]));
    raise(0, sum);
  }
  for (int64_t m = first; m < a.splat_count(); m += step) {
    if (!(splat_geometry(a)[m].opacity > T(0))) continue;  // its features were never written
    const T* row = splat_feature_rows(a) + m * a.features;
    for (int f = 0; f < sums.active; ++f) raise(2, fabs(double(row[f])));
  }
  for (int k = 0; k < 3; ++k) {
    for (int offset = 16; offset > 0; offset /= 2)
      largest[k] = fmax(largest[k], __shfl_xor_sync(kAllLanes, largest[k], offset));
    // Of numbers that are not negative, the bits are in the same order.
    if (threadIdx.x % 32 == 0)
      atomicMax(reinterpret_cast<unsigned long long*>(sums.fixed + k),
                static_cast<unsigned long long>(__double_as_longlong(largest[k])));
  }
}

// The order-free sums as floats, where the projection's adjoint looks for them.
template <typename T>
__global__ void __launch_bounds__(kBoundThreads)
    round_sums_kernel(RasterArgs<T> a, SplatSums<T> sums) {
  const int64_t k = int64_t(blockIdx.x) * kBoundThreads + threadIdx.x;
  const int width = sums.width();
  if (k >= a.splat_count() * width) return;
  T* out = sums.word(static_cast<int>(k % width), k / width);
  const int64_t* words = sums.fixed + SplatSums<T>::kBounds + 2 * k;
  if (!isnan(*out)) *out = T(units_of(a, sums).value(words[0], words[1]));
}

// Adds a splat's numbers, summed over the warp: eights, then a four or a one, so that a lane ends
// up with one word, and one instruction adds them all. kCount: words there are room for.
template <int kCount, bool kOrderFree, typename T>
class SumAdder {
 public:
  __device__ __forceinline__ SumAdder(const RasterArgs<T>& a, const SplatSums<T>& sums) {
    if constexpr (kOrderFree) {
      units_ = units_of(a, sums);
      fixed_ = sums.fixed + SplatSums<T>::kBounds;
    }
    const int lane = threadIdx.x % 32;
    int word = lane % 4 == 0 ? lane / 4 : -1;
    // The rest rides along with the first eight, on lanes that those leave free.
    if (kRest == 1 && lane == 1) word = kFirst;
    if (kRest > 1 && lane % 8 == 1) word = kFirst + lane / 8;
    target_ = word >= 0 && word < sums.width() ? sums.word(word, 0) : nullptr;
    stride_ = sums.stride_of(word);
    width_ = sums.width();
    word_ = word;
  }

  __device__ __forceinline__ void add(const T* value, int64_t id) const {
    const int lane = threadIdx.x % 32;
#pragma unroll
    for (int e = 1; e < kEights; ++e) {  // more than twelve words stand in one array
      if (8 * e >= width_) break;
      const T total = eight(value, 8 * e);
      if (lane % 4 == 0 && 8 * e + lane / 4 < width_) add_word(id, 8 * e, total);
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
    if (target_) add_word(id, 0, total);
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

  // Adds to the lane's word, or the one `more` behind it.
  __device__ __forceinline__ void add_word(int64_t id, int more, T value) const {
    T* address = target_ + id * stride_ + more;
    if constexpr (kOrderFree) {
      int64_t coarse, fine;
      if (!units_.split(double(value), &coarse, &fine)) {
        *address = T(NAN);  // by whom, and how often, makes no difference
        return;
      }
      int64_t* words = fixed_ + 2 * (id * width_ + word_ + more);
      if (coarse != 0) add_global(words, coarse);
      if (fine != 0) add_global(words + 1, fine);
    } else {
      add_global(address, value);
    }
  }

  // Said to the compiler, which else allows for shared memory with a loop.
  __device__ __forceinline__ static void add_global(T* address, T value) {
    __builtin_assume(__isGlobal(address));
    atomicAdd(address, value);
  }
  __device__ __forceinline__ static void add_global(int64_t* address, int64_t value) {
    __builtin_assume(__isGlobal(address));
    atomicAdd(reinterpret_cast<unsigned long long*>(address),
              static_cast<unsigned long long>(value));
  }

  T* target_;  // word of this lane of splat 0, or null
  int stride_, width_, word_;
  OrderFreeUnits units_;
  int64_t* fixed_;
};

template <typename T, int kF, bool kGroups, bool kAbsolute, bool kOrderFree>
__global__ void __launch_bounds__(kBlockThreads)
    blend_backward_kernel(RasterGradArgs<T> b, SplatSums<T> sums) {
  __shared__ StagedSplat<T, kF> stage[kBlockWarps][32];
  const RasterArgs<T>& a = b.forward;
  const int active = sums.active;
  const SumAdder<kGradFeatures + (kAbsolute ? 2 : 0) + kF, kOrderFree, T> adder(a, sums);
  const WarpPlace place = warp_place(a);
  const T px = T(place.lane_x) + T(0.5);

  PixelWalk<T, kGroups> walk[kLanePixels];
  T grad[kLanePixels][kF];
  // What everything from the current splat to the back adds to the loss, reduced splat by splat.
  T behind[kLanePixels];
#pragma unroll
  for (int p = 0; p < kLanePixels; ++p) {
    const int y = place.lane_y + p * kLaneRows;
    const bool inside = place.lane_x < a.width && y < a.height;
    const int64_t pixel =
        inside ? (int64_t(place.camera) * a.height + y) * a.width + place.lane_x : 0;
    walk[p].start(inside);
    behind[p] = pixel_gradient<T, kF>(b, active, pixel, inside, grad[p]);
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

// Sum of the image's gradient that shines through, per channel, in one order: every block leaves
// its share, and one warp per channel adds the shares up.
constexpr int kBackgroundThreads = 256, kBackgroundBlocks = 264;

template <typename T>
__global__ void __launch_bounds__(kBackgroundThreads)
    background_kernel(RasterGradArgs<T> b, T* share) {
  const RasterArgs<T>& a = b.forward;
  const int64_t pixels = int64_t(a.width) * a.height, first = blockIdx.y * pixels;
  __shared__ T warps[kBackgroundThreads / 32];
  for (int c = 0; c < a.channels; ++c) {
    T sum = T(0);
    for (int64_t k = int64_t(blockIdx.x) * blockDim.x + threadIdx.x; k < pixels;
         k += int64_t(gridDim.x) * blockDim.x)
      sum += b.grad_image[(first + k) * a.channels + c] * (T(1) - a.alpha[first + k]);
    sum = warp_sum(sum);
    if (threadIdx.x % 32 == 0) warps[threadIdx.x / 32] = sum;
    __syncthreads();
    if (threadIdx.x == 0) {
      T all = T(0);
      for (const T part : warps) all += part;
      share[(int64_t(blockIdx.y) * kBackgroundBlocks + blockIdx.x) * a.channels + c] = all;
    }
    __syncthreads();
  }
}

// A block of one warp per channel, and per camera when each has a background of its own.
template <typename T>
__global__ void background_sum_kernel(RasterGradArgs<T> b, const T* share) {
  const RasterArgs<T>& a = b.forward;
  const bool own = a.background_stride > 0;
  const int64_t shares = int64_t(kBackgroundBlocks) * (own ? 1 : a.cameras);
  const int64_t first = own ? int64_t(blockIdx.y) * kBackgroundBlocks : 0;
  T sum = T(0);
  for (int64_t k = threadIdx.x; k < shares; k += 32)
    sum += share[(first + k) * a.channels + blockIdx.x];
  sum = warp_sum(sum);
  if (threadIdx.x == 0)
    b.grad_background[int64_t(blockIdx.y) * a.background_stride + blockIdx.x] += sum;
}

}  // namespace

template <typename T>
SplatSums<T> raster_sums(const RasterGradArgs<T>& b, T* own, int64_t* fixed) {
  const RasterArgs<T>& a = b.forward;
  SplatSums<T> s{};
  s.fixed = fixed;
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
  const SplatSums<T> s = raster_sums<T>(b, nullptr, nullptr);
  return s.part[0] ? 0 : b.forward.splat_count() * s.stride[0];
}

template <typename T>
int64_t raster_fixed_size(const RasterGradArgs<T>& b) {
  const SplatSums<T> s = raster_sums<T>(b, nullptr, nullptr);
  return b.deterministic ? SplatSums<T>::kBounds + 2 * b.forward.splat_count() * s.width() : 0;
}

template <typename T>
int64_t raster_background_size(const RasterGradArgs<T>& b) {
  const RasterArgs<T>& a = b.forward;
  return b.grad_background ? int64_t(kBackgroundBlocks) * a.cameras * a.channels : 0;
}

template <typename T>
cudaError_t raster_backward(const RasterGradArgs<T>& b, const SplatSums<T>& sums, T* background,
                            cudaStream_t stream) {
  const RasterArgs<T>& a = b.forward;
  if (b.grad_background && b.grad_image) {
    background_kernel<T>
        <<<dim3(kBackgroundBlocks, a.cameras), kBackgroundThreads, 0, stream>>>(b, background);
    background_sum_kernel<T>
        <<<dim3(a.channels, a.background_stride > 0 ? a.cameras : 1), 32, 0, stream>>>(b,
                                                                                       background);
  }
  if (a.count == 0) return cudaGetLastError();
  for (int p = 0; p < SplatSums<T>::kParts; ++p) {
    if (p > 0 && sums.part[p] == sums.part[p - 1]) break;  // one array for all
    const size_t bytes = sizeof(T) * static_cast<size_t>(a.splat_count() * sums.stride[p]);
    const cudaError_t error = cudaMemsetAsync(sums.part[p], 0, bytes, stream);
    if (error != cudaSuccess) return error;
  }
  if (sums.fixed) {
    const size_t bytes = sizeof(int64_t) * static_cast<size_t>(raster_fixed_size(b));
    const cudaError_t error = cudaMemsetAsync(sums.fixed, 0, bytes, stream);
    if (error != cudaSuccess) return error;
  }
  const cudaError_t error =
      with_variant<T>(sums.active, a.groups != nullptr, [&]<int kF, bool kGroups>() {
        const auto run = [&]<bool kAbsolute, bool kOrderFree>() {
          // Absolute sums are asked for in training, of rgb and depth; what else may want them
          // shares a kernel: twelve fewer to build and to ship.
          constexpr int kRoom = kAbsolute && (kF > 4 || kGroups) ? kMaxFeatures : kF;
          blend_backward_kernel<T, kRoom, kGroups, kAbsolute, kOrderFree>
              <<<blend_blocks(a), kBlockThreads, 0, stream>>>(b, sums);
        };
        if (sums.fixed) {
          bounds_kernel<T, kF><<<kBoundBlocks, kBoundThreads, 0, stream>>>(b, sums);
          if (b.grad_absolute)
            run.template operator()<true, true>();
          else
            run.template operator()<false, true>();
          const int64_t words = a.splat_count() * sums.width();
          const auto blocks = static_cast<unsigned>((words + kBoundThreads - 1) / kBoundThreads);
          round_sums_kernel<T><<<blocks, kBoundThreads, 0, stream>>>(a, sums);
        } else if (b.grad_absolute) {
          run.template operator()<true, false>();
        } else {
          run.template operator()<false, false>();
        }
        return cudaGetLastError();
      });
  return error == cudaSuccess ? raster_gaussian_backward(b, sums, stream) : error;
}

#define GSF_INSTANTIATE(T)                                                                   \
  template SplatSums<T> raster_sums(const RasterGradArgs<T>&, T*, int64_t*);                 \
  template int64_t raster_sums_size(const RasterGradArgs<T>&);                               \
  template int64_t raster_fixed_size(const RasterGradArgs<T>&);                              \
  template int64_t raster_background_size(const RasterGradArgs<T>&);                         \
  template cudaError_t raster_backward<T>(const RasterGradArgs<T>&, const SplatSums<T>&, T*, \
                                          cudaStream_t);
GSF_INSTANTIATE(float)
GSF_INSTANTIATE(double)
#undef GSF_INSTANTIATE

}  // namespace gsf::cuda
