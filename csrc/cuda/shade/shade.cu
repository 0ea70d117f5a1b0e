// CUDA kernel of the shading op: one thread per pixel, a warp on 8x4 pixels, whose taps into the
// shadow map lie close together.
#include "core/shade/shade.h"
#include "cuda/shade/launch.h"

namespace gsf::cuda {
namespace {

constexpr int kColumns = 8, kLines = 16;

template <typename T>
__global__ void __launch_bounds__(kColumns* kLines) shade_kernel(ShadeArgs<T> a) {
  const int64_t column = int64_t(blockIdx.x) * kColumns + threadIdx.x;
  const int64_t line = int64_t(blockIdx.y) * kLines + threadIdx.y;
  if (column < a.width && line < a.height) shade_pixel<ShadowTaps<T>>(a, column, line);
}

}  // namespace

template <typename T>
cudaError_t shade(const ShadeArgs<T>& a, cudaStream_t stream) {
  const dim3 blocks(static_cast<unsigned>((a.width + kColumns - 1) / kColumns),
                    static_cast<unsigned>((a.height + kLines - 1) / kLines));
  shade_kernel<T><<<blocks, dim3(kColumns, kLines), 0, stream>>>(a);
  return cudaGetLastError();
}

template cudaError_t shade(const ShadeArgs<float>&, cudaStream_t);
template cudaError_t shade(const ShadeArgs<double>&, cudaStream_t);

}  // namespace gsf::cuda
