// CUDA kernels of the enclosing-ellipsoid ops: one warp per fit.
#include "core/mvee_lens.h"
#include "cuda/launch_material.h"

namespace gsf::cuda {
namespace {

constexpr int kWarps = 4;  // fits per block
constexpr unsigned kAll = 0xffffffffu;

// The 32 lanes of a warp; every lane must reach every call.
struct WarpTeam {
  __device__ int rank() const { return threadIdx.x % 32; }
  __device__ int size() const { return 32; }
  __device__ void sync() const { __syncwarp(); }
  template <typename T>
  __device__ T sum(T x) const {
    for (int offset = 16; offset > 0; offset /= 2) x += __shfl_xor_sync(kAll, x, offset);
    return x;
  }
  template <typename T>
  __device__ void largest(T& value, int& index) const {
    for (int offset = 16; offset > 0; offset /= 2) {
      const T v = __shfl_xor_sync(kAll, value, offset);
      const int i = __shfl_xor_sync(kAll, index, offset);
      if (v > value || (v == value && i < index)) {
        value = v;
        index = i;
      }
    }
  }
};

template <typename T>
__global__ void __launch_bounds__(32 * kWarps) mvee_kernel(const MveeArgs<T> a) {
  const int64_t i = int64_t(blockIdx.x) * kWarps + threadIdx.x / 32;
  if (i >= a.batch) return;  // whole warps leave together
  const WarpTeam team;
  const Ellipsoid<T> fit = mvee_fit(team, a.points + 3 * a.count * i, static_cast<int>(a.count),
                                    a.weight + a.count * i, a.tolerance, a.max_iterations);
  if (team.rank() != 0) return;
  for (int c = 0; c < 3; ++c) a.center[3 * i + c] = fit.center[c];
  store_mat3(a.shape + 9 * i, to_mat3(fit.shape));
}

template <typename T>
__global__ void __launch_bounds__(32 * kWarps) mvee_lens_kernel(const MveeLensArgs<T> a) {
  __shared__ T points[kWarps][3 * kLensRays];
  __shared__ T weight[kWarps][kLensRays];
  const int warp = threadIdx.x / 32;
  const int64_t i = int64_t(blockIdx.x) * kWarps + warp;
  if (i >= a.batch) return;
  const WarpTeam team;
  const Vec3<T> mean_a{a.mean_a[3 * i], a.mean_a[3 * i + 1], a.mean_a[3 * i + 2]};
  const Vec3<T> mean_b{a.mean_b[3 * i], a.mean_b[3 * i + 1], a.mean_b[3 * i + 2]};
  const LensResult<T> r =
      gsf::mvee_lens(team, mean_a, load_sym3(a.covariance_a + 6 * i), mean_b,
                     load_sym3(a.covariance_b + 6 * i), a.radius, points[warp], weight[warp]);
  if (team.rank() != 0) return;
  for (int c = 0; c < 3; ++c) a.mean[3 * i + c] = r.mean[c];
  store_sym3(a.covariance + 6 * i, r.covariance);
  a.overlap[i] = r.overlap;
}

}  // namespace

template <typename T>
cudaError_t mvee(const MveeArgs<T>& args, cudaStream_t stream) {
  if (args.batch == 0) return cudaSuccess;
  const unsigned blocks = static_cast<unsigned>((args.batch + kWarps - 1) / kWarps);
  mvee_kernel<T><<<blocks, 32 * kWarps, 0, stream>>>(args);
  return cudaGetLastError();
}

template <typename T>
cudaError_t mvee_lens(const MveeLensArgs<T>& args, cudaStream_t stream) {
  if (args.batch == 0) return cudaSuccess;
  const unsigned blocks = static_cast<unsigned>((args.batch + kWarps - 1) / kWarps);
  mvee_lens_kernel<T><<<blocks, 32 * kWarps, 0, stream>>>(args);
  return cudaGetLastError();
}

template cudaError_t mvee(const MveeArgs<float>&, cudaStream_t);
template cudaError_t mvee(const MveeArgs<double>&, cudaStream_t);
template cudaError_t mvee_lens(const MveeLensArgs<float>&, cudaStream_t);
template cudaError_t mvee_lens(const MveeLensArgs<double>&, cudaStream_t);

}  // namespace gsf::cuda
