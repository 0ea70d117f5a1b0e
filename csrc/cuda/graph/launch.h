// Launchers of the kernels on graphs: torch-free.
#pragma once

#include <cuda_runtime_api.h>

#include "core/graph.h"

namespace gsf::cuda {

cudaError_t link_costs(const LinkCostsArgs& a, cudaStream_t stream);
cudaError_t components(const ComponentsArgs& a, cudaStream_t stream);
// Waits for the stream: it ends when nothing changes any more.
cudaError_t nearest_seeds(const NearestSeedsArgs& a, cudaStream_t stream);

}  // namespace gsf::cuda
