// Launcher of the optimiser step; torch-free.
#pragma once

#include <cuda_runtime_api.h>

#include "core/train/adam.h"

namespace gsf::cuda {

template <typename T>
cudaError_t adam_step(const AdamArgs<T>& args, cudaStream_t stream);

}  // namespace gsf::cuda
