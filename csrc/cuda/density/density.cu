// CUDA kernels of the density ops: scatter with atomics (the grid lies in the L2 cache), pooling,
// separable smoothing, one thread per cell or splat.
#include "core/density.h"
#include "cuda/density/launch.h"
#include "cuda/threads.h"

namespace gsf::cuda {
namespace {

// Whole numbers: the order in which threads come changes no bit.
template <typename T>
__global__ void scatter_kernel(DensityArgs<T> a, double per_weight) {
  const int64_t i = thread_number();
  DensityPlace<T> place;
  if (i >= a.count || !place.of(a.frame, a.nodes, a.means + 3 * i)) return;
  for (int corner = 0; corner < 8; ++corner)
    atomicAdd(
        reinterpret_cast<unsigned long long*>(a.units + place.cell(corner, a.nodes)),
        static_cast<unsigned long long>(__double2ll_rn(double(place.weight(corner)) * per_weight)));
}

template <typename T>
__global__ void occupied_kernel(DensityArgs<T> a, int64_t cells, double per_weight) {
  const int64_t k = thread_number();
  if (k >= cells) return;
  const int64_t units = a.units[k];
  if (units != 0) a.values[k] = T(double(units) / per_weight) * (T(1) / a.full);
}

// Cuts the finest level off at one and averages it into the next.
template <typename T>
__global__ void pool_kernel(T* fine, T* coarse, int side, bool cut) {
  const int64_t k = thread_number();
  if (k >= int64_t(side) * side * side) return;
  const int64_t x = k % side, y = k / side % side, z = k / side / side, twice = 2 * side;
  T sum = T(0);
  for (int c = 0; c < 8; ++c) {
    T* cell = fine + ((2 * z + (c >> 2)) * twice + 2 * y + (c >> 1 & 1)) * twice + 2 * x + (c & 1);
    T value = *cell;
    if (cut && value > T(1)) *cell = value = T(1);
    sum += value;
  }
  coarse[k] = T(0.125) * sum;
}

template <typename T, int kPasses, int kAxis>
__global__ void smooth_kernel(const T* in, T* out, int side) {
  const int64_t k = thread_number();
  if (k >= int64_t(side) * side * side) return;
  const int at = kAxis == 0 ? static_cast<int>(k % side)
                            : static_cast<int>(kAxis == 1 ? k / side % side : k / side / side);
  const int64_t step = kAxis == 0 ? 1 : (kAxis == 1 ? side : int64_t(side) * side);
  T sum = T(0);
#pragma unroll
  for (int offset = -kPasses; offset <= kPasses; ++offset)
    if (at + offset >= 0 && at + offset < side)
      sum += binomial_weight<T>(kPasses, offset) * in[k + offset * step];
  out[k] = sum;
}

template <typename T, int kPasses>
void smooth(const T* in, T* out, T* spare, int side, cudaStream_t stream) {
  const unsigned blocks = blocks_for(int64_t(side) * side * side);
  smooth_kernel<T, kPasses, 0><<<blocks, kThreads, 0, stream>>>(in, out, side);
  smooth_kernel<T, kPasses, 1><<<blocks, kThreads, 0, stream>>>(out, spare, side);
  smooth_kernel<T, kPasses, 2><<<blocks, kThreads, 0, stream>>>(spare, out, side);
}

__device__ inline double warp_total(double v) {
  for (int offset = 16; offset > 0; offset /= 2) v += __shfl_xor_sync(0xffffffffu, v, offset);
  return v;
}

template <typename T>
__global__ void __launch_bounds__(kThreads) bulk_sums_kernel(BulkArgs<T> a) {
  double sum[kBulkSums] = {};
  const int64_t step = int64_t(gridDim.x) * kThreads;
  for (int64_t i = thread_number(); i < a.count; i += step) bulk_terms(a, i, sum);
  // Every block leaves its share; they are added up in one order.
  __shared__ double warps[kThreads / 32][kBulkSums];
  for (int k = 0; k < kBulkSums; ++k) {
    const double total = warp_total(sum[k]);
    if (threadIdx.x % 32 == 0) warps[threadIdx.x / 32][k] = total;
  }
  __syncthreads();
  if (threadIdx.x >= kBulkSums) return;
  double all = 0.0;
  for (int w = 0; w < kThreads / 32; ++w) all += warps[w][threadIdx.x];
  a.shares[blockIdx.x * kBulkSums + threadIdx.x] = all;
}

// One warp.
template <typename T>
__global__ void bulk_finish_kernel(BulkArgs<T> a, int shares) {
  double sum[kBulkSums] = {};
  for (int s = threadIdx.x; s < shares; s += 32)
    for (int k = 0; k < kBulkSums; ++k) sum[k] += a.shares[s * kBulkSums + k];
  for (int k = 0; k < kBulkSums; ++k) sum[k] = warp_total(sum[k]);
  if (threadIdx.x == 0) bulk_finish(sum, a.out);
}

template <typename T>
__global__ void bulk_root_kernel(BulkArgs<T> a) {
  a.out[4] = sqrt(a.out[4]);
}

template <typename T>
__global__ void __launch_bounds__(kThreads) bulk_reach_kernel(BulkArgs<T> a) {
  double most = 0.0;
  const int64_t step = int64_t(gridDim.x) * kThreads;
  for (int64_t i = thread_number(); i < a.count; i += step) most = max(most, bulk_away(a, i));
  for (int offset = 16; offset > 0; offset /= 2)
    most = max(most, __shfl_xor_sync(0xffffffffu, most, offset));
  // Of numbers that are not negative, the bits are in the same order.
  if (threadIdx.x % 32 == 0)
    atomicMax(reinterpret_cast<unsigned long long*>(a.out + 4),
              static_cast<unsigned long long>(__double_as_longlong(most)));
}

template <typename T>
__global__ void normal_kernel(DensityNormalArgs<T> a) {
  const int64_t i = thread_number();
  if (i < a.count) density_normal(a, i);
}

}  // namespace

template <typename T>
cudaError_t occupancy(const DensityArgs<T>& a, cudaStream_t stream) {
  if (a.count > 0) {
    const int64_t cells = int64_t(a.nodes) * a.nodes * a.nodes;
    scatter_kernel<T><<<blocks_for(a.count), kThreads, 0, stream>>>(a, a.per_weight());
    occupied_kernel<T><<<blocks_for(cells), kThreads, 0, stream>>>(a, cells, a.per_weight());
  }
  for (int level = 1; level < kDensityLevels; ++level) {
    const int64_t side = a.nodes >> level;
    pool_kernel<T><<<blocks_for(side * side * side), kThreads, 0, stream>>>(
        a.values + density_level(a.nodes, level - 1), a.values + density_level(a.nodes, level),
        static_cast<int>(side), level == 1);
  }
  return cudaGetLastError();
}

template <typename T>
cudaError_t splat_bulk(const BulkArgs<T>& a, cudaStream_t stream) {
  const unsigned needed = blocks_for(a.count), blocks = needed < kBulkShares ? needed : kBulkShares;
  if (a.count > 0) bulk_sums_kernel<T><<<blocks, kThreads, 0, stream>>>(a);
  bulk_finish_kernel<T><<<1, 32, 0, stream>>>(a, a.count > 0 ? static_cast<int>(blocks) : 0);
  if (a.count > 0) bulk_reach_kernel<T><<<blocks, kThreads, 0, stream>>>(a);
  bulk_root_kernel<T><<<1, 1, 0, stream>>>(a);
  return cudaGetLastError();
}

template <typename T>
cudaError_t density_normals(const DensityNormalArgs<T>& a, cudaStream_t stream) {
  smooth<T, kDensityPasses>(a.values, a.fine, a.spare, a.nodes, stream);
  smooth<T, 1>(a.values + density_level(a.nodes, kDensityWide), a.wide, a.spare,
               a.nodes >> kDensityWide, stream);
  normal_kernel<T><<<blocks_for(a.count), kThreads, 0, stream>>>(a);
  return cudaGetLastError();
}

template cudaError_t occupancy(const DensityArgs<float>&, cudaStream_t);
template cudaError_t occupancy(const DensityArgs<double>&, cudaStream_t);
template cudaError_t splat_bulk(const BulkArgs<float>&, cudaStream_t);
template cudaError_t splat_bulk(const BulkArgs<double>&, cudaStream_t);
template cudaError_t density_normals(const DensityNormalArgs<float>&, cudaStream_t);
template cudaError_t density_normals(const DensityNormalArgs<double>&, cudaStream_t);

}  // namespace gsf::cuda
