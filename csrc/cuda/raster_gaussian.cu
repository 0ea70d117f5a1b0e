// Adjoint of the projection on CUDA: one thread per Gaussian takes the sums over the pixels of all
// cameras to the inputs. Every gradient is written, so none needs to be zeroed before.
#include "cuda/launch_raster.h"
#include "cuda/raster_layout.h"
#include "cuda/raster_rows.h"

namespace gsf::cuda {
namespace {

__device__ __forceinline__ void prefetch(const void* address) {
  asm volatile("prefetch.global.L1 [%0];" ::"l"(address));
}

template <typename T, int kDegree>
__global__ void __launch_bounds__(kRowThreads, 4)
    gaussian_backward_kernel(RasterGradArgs<T> b, SplatSums<T> sums) {
  const RasterArgs<T>& a = b.forward;
  const int64_t i = int64_t(blockIdx.x) * kRowThreads + threadIdx.x;
  const bool real = i < a.count;
  const auto seen_by = [&](int camera) {
    return splat_geometry(a)[camera * a.count + i].opacity > T(0);
  };
  // What a thread reads after it knows that its Gaussian was seen is on its way before.
  if (real) {
    prefetch(a.means + 3 * i);
    prefetch(a.opacities + i);
    prefetch(a.covars ? a.covars + 6 * i : a.quats + 4 * i);
    if (a.scales) prefetch(a.scales + 3 * i);
    prefetch(sums.word(0, i));
    prefetch(sums.word(sums.end[0], i));
    prefetch(sums.word(sums.width() - 1, i));
  }
  bool seen = false;
  for (int camera = 0; real && camera < a.cameras; ++camera) seen = seen || seen_by(camera);
  const int degree = kDegree > 0 ? kDegree : a.sh_degree;
  const T* sh = a.sh;
  T* shared = nullptr;
  if constexpr (kDegree > 0) {
    __shared__ T rows[kRowThreads * row_stride(kDegree)];
    shared = load_rows<T, kDegree>(a.sh, i, seen, rows);
    sh = shared;
  } else if (sh) {
    sh += 3 * sh_coefficients(degree) * i;
  }

  GaussianGradient<T> total;
  T basis[kMaxShCoefficients], rgb[3] = {T(0), T(0), T(0)};
  const int depth_at = b.grad_depth ? sums.features + a.features - 1 : -1;
  if (real) {
    if (b.grad_colors)
      for (int c = 0; c < a.channels; ++c) b.grad_colors[a.channels * i + c] = T(0);
    if (b.grad_normals)
      for (int c = 0; c < 3; ++c) b.grad_normals[3 * i + c] = T(0);
  }
  for (int camera = 0; real && camera < a.cameras; ++camera) {
    const int64_t m = camera * a.count + i;
    const bool here = seen_by(camera);
    const auto sum = [&](int k) { return *sums.word(k, m); };
    T g[kGradFeatures] = {};
    if (here) {
      T moment[kGradFeatures];
      for (int k = 0; k < kGradFeatures; ++k) moment[k] = sum(k);
      const SplatGeometry<T> s = splat_geometry(a)[m];
      moments_to_gradient(moment, s.a, s.b, s.c, s.opacity, g);
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
    const SplatCamera<T> view = raster_camera(a, camera);
    geometry_backward(a, view, i, g, depth_at < 0 ? T(0) : sum(depth_at), &total);
    if (sh) {
      const Vec3<T> mean{a.means[3 * i], a.means[3 * i + 1], a.means[3 * i + 2]};
      for (int c = 0; c < 3; ++c) rgb[c] = sum(sums.features + c);
      sh_direction_backward(degree, view, mean, sh, rgb, basis, &total.mean);
      // Kept for the second round, below; with one camera the registers hold it.
      if (a.cameras > 1)
        for (int c = 0; c < 3; ++c) *sums.word(sums.features + c, m) = rgb[c];
    } else {
      for (int c = 0; c < a.channels; ++c)
        b.grad_colors[a.channels * i + c] += sum(sums.features + c);
    }
    if (b.grad_normals && sums.active > a.channels)
      for (int c = 0; c < 3; ++c) b.grad_normals[3 * i + c] += sum(sums.features + a.channels + c);
  }
  if (real) store_gaussian_gradient(b, i, total);

  if (!a.sh) return;
  // Gradient of the coefficients, the coefficients being no longer needed.
  const int k = sh_coefficients(degree);
  T* out = kDegree > 0 ? shared : b.grad_sh + 3 * k * i;
  if (real || kDegree > 0) {
    if (a.cameras == 1) {
      for (int j = 0; j < k; ++j)
        for (int c = 0; c < 3; ++c) out[3 * j + c] = seen ? rgb[c] * basis[j] : T(0);
    } else {
      for (int j = 0; j < 3 * k; ++j) out[j] = T(0);
      for (int camera = 0; seen && camera < a.cameras; ++camera) {
        if (!seen_by(camera)) continue;
        const int64_t m = camera * a.count + i;
        const Vec3<T> mean{a.means[3 * i], a.means[3 * i + 1], a.means[3 * i + 2]};
        T length;
        sh_basis(degree, view_direction(raster_camera(a, camera), mean, &length), basis);
        for (int j = 0; j < k; ++j)
          for (int c = 0; c < 3; ++c) out[3 * j + c] += *sums.word(sums.features + c, m) * basis[j];
      }
    }
  }
  if constexpr (kDegree > 0)
    store_rows<T, kDegree>(b.grad_sh, i, real, shared - threadIdx.x * row_stride(kDegree));
}

}  // namespace

template <typename T>
cudaError_t raster_gaussian_backward(const RasterGradArgs<T>& b, const SplatSums<T>& sums,
                                     cudaStream_t stream) {
  const RasterArgs<T>& a = b.forward;
  const auto blocks = static_cast<unsigned>((a.count + kRowThreads - 1) / kRowThreads);
  return with_degree<T>(a, [&]<int kDegree>() {
    gaussian_backward_kernel<T, kDegree><<<blocks, kRowThreads, 0, stream>>>(b, sums);
    return cudaGetLastError();
  });
}

template cudaError_t raster_gaussian_backward<float>(const RasterGradArgs<float>&,
                                                     const SplatSums<float>&, cudaStream_t);
template cudaError_t raster_gaussian_backward<double>(const RasterGradArgs<double>&,
                                                      const SplatSums<double>&, cudaStream_t);

}  // namespace gsf::cuda
