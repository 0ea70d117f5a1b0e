// Launcher of the shading kernel: torch-free.
#pragma once

#include <cuda_runtime_api.h>

#include "core/shade/args.h"

namespace gsf::cuda {

template <typename T>
cudaError_t shade(const ShadeArgs<T>& a, cudaStream_t stream);

}  // namespace gsf::cuda
