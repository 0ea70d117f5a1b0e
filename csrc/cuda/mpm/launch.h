// Launchers of the MPM kernels; torch-free, so that csrc/cuda/mpm/mpm.cu compiles without torch
// headers.
#pragma once

#include <cuda_runtime_api.h>

#include "core/mpm/args.h"

namespace gsf::cuda {

template <typename T>
cudaError_t p2g(const P2GArgs<T>& a, cudaStream_t stream);
template <typename T>
cudaError_t g2p(const GatherArgs<T>& a, cudaStream_t stream);
template <typename T>
cudaError_t p2g_adjoint(const GatherArgs<T>& a, cudaStream_t stream);
template <typename T>
cudaError_t grid_update(const GridUpdateArgs<T>& a, cudaStream_t stream);

}  // namespace gsf::cuda
