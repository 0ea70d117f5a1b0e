// Launchers of the kernels of a texture's synthesis: torch-free.
#pragma once

#include <cuda_runtime_api.h>

#include "core/texture.h"

namespace gsf::cuda {

cudaError_t rows_between(const RowsBetweenArgs& a, cudaStream_t stream);
cudaError_t quantile_shift(const QuantileShiftArgs& a, cudaStream_t stream);
cudaError_t patch_votes(const PatchVotesArgs& a, cudaStream_t stream);

}  // namespace gsf::cuda
