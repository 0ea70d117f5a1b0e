// Launchers of the density kernels: torch-free.
#pragma once

#include <cuda_runtime_api.h>

#include "core/density.h"

namespace gsf::cuda {

// `values` and `units` come in as zeros.
template <typename T>
cudaError_t occupancy(const DensityArgs<T>& a, cudaStream_t stream);
// `out` comes in as zeros.
template <typename T>
cudaError_t splat_bulk(const BulkArgs<T>& a, cudaStream_t stream);
template <typename T>
cudaError_t density_normals(const DensityNormalArgs<T>& a, cudaStream_t stream);

}  // namespace gsf::cuda
