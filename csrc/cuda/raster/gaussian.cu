// Adjoint of the projection on CUDA: one thread per Gaussian takes the sums over the pixels of all
// cameras to the inputs, colours first, then geometry: two kernels of few registers hide the
// latency of memory better than one of many. Every gradient is written, so none needs to be zeroed
// before.
#include "cuda/raster/launch.h"
#include "cuda/raster/layout.h"
#include "cuda/raster/rows.h"

namespace gsf::cuda {
namespace {

template <typename T>
__device__ __forceinline__ bool seen_by(const RasterArgs<T>& a, int camera, int64_t i) {
  return splat_geometry(a)[camera * a.count + i].opacity > T(0);
}

// Gradient of the coefficients. What the colours say of the mean, through the view direction, is
// left in the first camera's words of the colours, for the kernel below.
template <typename T, int kDegree>
__global__ void __launch_bounds__(kRowThreads, 4)
    color_backward_kernel(RasterGradArgs<T> b, SplatSums<T> sums) {
  const RasterArgs<T>& a = b.forward;
  const int64_t i = int64_t(blockIdx.x) * kRowThreads + threadIdx.x;
  const bool real = i < a.count;
  bool seen = false;
  for (int camera = 0; real && camera < a.cameras; ++camera) seen = seen || seen_by(a, camera, i);
  const int degree = kDegree > 0 ? kDegree : a.sh_degree, k = sh_coefficients(degree);
  // Coefficients, then their gradient, of one Gaussian: in registers, or where they stand.
  const T* sh = a.sh + 3 * k * i;
  T* out = b.grad_sh + 3 * k * i;
  using Rows = std::conditional_t<(kDegree > 0), SharedRows<T, kDegree>, char>;
  __shared__ Rows rows;
  alignas(16) T row[RowLayout<T, kDegree>::kSize];
  if constexpr (kDegree > 0) {
    rows.load(a.sh, i, seen, row);
    sh = out = row;
  }
  Vec3<T> to_mean{T(0), T(0), T(0)};
  T basis[kMaxShCoefficients], rgb[3] = {T(0), T(0), T(0)};
  const auto word = [&](int camera, int c) {
    return sums.word(sums.features + c, camera * a.count + i);
  };
  for (int camera = 0; seen && camera < a.cameras; ++camera) {
    if (!seen_by(a, camera, i)) continue;
    const Vec3<T> mean{a.means[3 * i], a.means[3 * i + 1], a.means[3 * i + 2]};
    for (int c = 0; c < 3; ++c) rgb[c] = *word(camera, c);
    sh_direction_backward(degree, raster_camera(a, camera), mean, sh, rgb, basis, &to_mean);
    // Kept for the second round, below; with one camera the registers hold it.
    if (a.cameras > 1)
      for (int c = 0; c < 3; ++c) *word(camera, c) = rgb[c];
  }
  // The coefficients are no longer needed: their gradient takes their place.
  if (a.cameras == 1 && (real || kDegree > 0)) {
    for (int j = 0; j < k; ++j)
      for (int c = 0; c < 3; ++c) out[3 * j + c] = seen ? rgb[c] * basis[j] : T(0);
  } else if (real || kDegree > 0) {
    for (int j = 0; j < 3 * k; ++j) out[j] = T(0);
    for (int camera = 0; seen && camera < a.cameras; ++camera) {
      if (!seen_by(a, camera, i)) continue;
      const Vec3<T> mean{a.means[3 * i], a.means[3 * i + 1], a.means[3 * i + 2]};
      T length;
      sh_basis(degree, view_direction(raster_camera(a, camera), mean, &length), basis);
      for (int j = 0; j < k; ++j)
        for (int c = 0; c < 3; ++c) out[3 * j + c] += *word(camera, c) * basis[j];
    }
  }
  if (real)
    for (int c = 0; c < 3; ++c) *word(0, c) = to_mean[c];
  if constexpr (kDegree > 0) rows.store(b.grad_sh, i, real, row);
}

template <typename T>
__global__ void __launch_bounds__(kRowThreads, 5)
    geometry_backward_kernel(RasterGradArgs<T> b, SplatSums<T> sums) {
  const RasterArgs<T>& a = b.forward;
  const int64_t i = int64_t(blockIdx.x) * kRowThreads + threadIdx.x;
  if (i >= a.count) return;
  GaussianGradient<T> total;
  if (a.sh)
    total.mean = {*sums.word(sums.features, i), *sums.word(sums.features + 1, i),
                  *sums.word(sums.features + 2, i)};
  if (b.grad_colors)
    for (int c = 0; c < a.channels; ++c) b.grad_colors[a.channels * i + c] = T(0);
  if (b.grad_normals)
    for (int c = 0; c < a.vectors; ++c) b.grad_normals[a.vectors * i + c] = T(0);
  for (int camera = 0; camera < a.cameras; ++camera) {
    const int64_t m = camera * a.count + i;
    const SplatGeometry<T> s = splat_geometry(a)[m];
    const bool here = s.opacity > T(0);
    const auto sum = [&](int k) { return *sums.word(k, m); };
    T g[kGradFeatures] = {};
    if (here) {
      T moment[kGradFeatures];
      for (int k = 0; k < kGradFeatures; ++k) moment[k] = sum(k);
      moments_to_gradient(moment, s.conic, s.opacity, g);
    }
    if (b.grad_offset) {
      b.grad_offset[2 * m] = g[0];
      b.grad_offset[2 * m + 1] = g[1];
    }
    if (b.grad_absolute) {
      b.grad_absolute[2 * m] = here ? sum(kGradFeatures) : T(0);
      b.grad_absolute[2 * m + 1] = here ? sum(kGradFeatures + 1) : T(0);
    }
    if (!here) continue;
    const T depth = b.grad_depth ? sum(sums.features + a.features - 1) : T(0);
    geometry_backward(a, raster_camera(a, camera), i, g, depth, &total);
    if (b.grad_colors)
      for (int c = 0; c < a.channels; ++c)
        b.grad_colors[a.channels * i + c] += sum(sums.features + c);
    if (b.grad_normals && sums.active > a.channels)
      for (int c = 0; c < a.vectors; ++c)
        b.grad_normals[a.vectors * i + c] += sum(sums.features + a.channels + c);
  }
  store_gaussian_gradient(b, i, total);
}

}  // namespace

template <typename T>
cudaError_t raster_gaussian_backward(const RasterGradArgs<T>& b, const SplatSums<T>& sums,
                                     cudaStream_t stream) {
  const RasterArgs<T>& a = b.forward;
  const auto blocks = static_cast<unsigned>((a.count + kRowThreads - 1) / kRowThreads);
  if (a.sh) {
    // Both must be aligned for wide words.
    const bool aligned = reinterpret_cast<uintptr_t>(b.grad_sh) % sizeof(float4) == 0;
    const T* aligned_sh = aligned ? a.sh : b.grad_sh;
    const cudaError_t error = with_degree<T>(aligned_sh, a.sh_degree, [&]<int kDegree>() {
      color_backward_kernel<T, kDegree><<<blocks, kRowThreads, 0, stream>>>(b, sums);
      return cudaGetLastError();
    });
    if (error != cudaSuccess) return error;
  }
  geometry_backward_kernel<T><<<blocks, kRowThreads, 0, stream>>>(b, sums);
  return cudaGetLastError();
}

template cudaError_t raster_gaussian_backward<float>(const RasterGradArgs<float>&,
                                                     const SplatSums<float>&, cudaStream_t);
template cudaError_t raster_gaussian_backward<double>(const RasterGradArgs<double>&,
                                                      const SplatSums<double>&, cudaStream_t);

}  // namespace gsf::cuda
