// Launchers of the material kernels: what ops.cpp may call. Torch-free.
#pragma once

#include <cuda_runtime_api.h>

#include "core/material/args.h"

namespace gsf::cuda {

template <typename T>
cudaError_t return_mapping(const ReturnMappingArgs<T>& args, cudaStream_t stream);

template <typename T>
cudaError_t neo_hookean_energy(const StoredEnergyArgs<T>& args, cudaStream_t stream);

}  // namespace gsf::cuda
