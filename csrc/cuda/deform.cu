// CUDA kernel of polar_clamped: one thread per matrix.
#include "core/svd3.h"
#include "cuda/launch_material.h"

namespace gsf::cuda {
namespace {

template <typename T>
__global__ void polar_kernel(PolarArgs<T> a) {
  const int64_t i = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i >= a.count) return;
  Mat3<T> rotation, clamped;
  polar_clamped(load_mat3(a.deformation + 9 * i), a.lo, a.hi, rotation, clamped);
  store_mat3(a.rotation + 9 * i, rotation);
  store_mat3(a.clamped + 9 * i, clamped);
}

}  // namespace

template <typename T>
cudaError_t polar(const PolarArgs<T>& args, cudaStream_t stream) {
  if (args.count == 0) return cudaSuccess;
  constexpr int kThreads = 128;
  const unsigned blocks = static_cast<unsigned>((args.count + kThreads - 1) / kThreads);
  polar_kernel<T><<<blocks, kThreads, 0, stream>>>(args);
  return cudaGetLastError();
}

template cudaError_t polar(const PolarArgs<float>&, cudaStream_t);
template cudaError_t polar(const PolarArgs<double>&, cudaStream_t);

}  // namespace gsf::cuda
