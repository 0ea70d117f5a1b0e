// Launchers of the material kernels: what *_ops.cpp may call. Torch-free.
#pragma once

#include <cuda_runtime_api.h>

#include "core/material_args.h"

namespace gsf::cuda {

template <typename T>
cudaError_t polar(const PolarArgs<T>& args, cudaStream_t stream);

template <typename T>
cudaError_t return_mapping(const ReturnMappingArgs<T>& args, cudaStream_t stream);

template <typename T>
cudaError_t mvee(const MveeArgs<T>& args, cudaStream_t stream);

template <typename T>
cudaError_t mvee_lens(const MveeLensArgs<T>& args, cudaStream_t stream);

}  // namespace gsf::cuda
