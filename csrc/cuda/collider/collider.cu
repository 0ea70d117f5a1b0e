// CUDA kernels of the collider operators: one thread per (point, collider), one per collider,
// one per point.
#include "cuda/collider/launch.h"
#include "cuda/threads.h"

namespace gsf::cuda {
namespace {

template <typename Args>
__global__ void compute_kernel(Args a, int64_t count) {
  const int64_t i = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i < count) a.compute(i);
}

template <typename Args>
cudaError_t compute(const Args& a, int64_t count, cudaStream_t stream) {
  if (count == 0) return cudaSuccess;
  compute_kernel<<<blocks_for<kFewThreads>(count), kFewThreads, 0, stream>>>(a, count);
  return cudaGetLastError();
}

}  // namespace

template <typename T>
cudaError_t collider_distance(const ColliderDistanceArgs<T>& a, cudaStream_t stream) {
  return compute(a, a.points * a.rows, stream);
}

template <typename T>
cudaError_t advance_colliders(const AdvanceCollidersArgs<T>& a, cudaStream_t stream) {
  return compute(a, a.rows, stream);
}

template <typename T>
cudaError_t blade_sides(const BladeSidesArgs<T>& a, cudaStream_t stream) {
  return compute(a, a.points, stream);
}

#define GSF_INSTANTIATE(T)                                                                 \
  template cudaError_t collider_distance<T>(const ColliderDistanceArgs<T>&, cudaStream_t); \
  template cudaError_t advance_colliders<T>(const AdvanceCollidersArgs<T>&, cudaStream_t); \
  template cudaError_t blade_sides<T>(const BladeSidesArgs<T>&, cudaStream_t);
GSF_INSTANTIATE(float)
GSF_INSTANTIATE(double)
#undef GSF_INSTANTIATE

}  // namespace gsf::cuda
