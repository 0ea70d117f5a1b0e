// Launchers of the collider kernels; torch-free.
#pragma once

#include <cuda_runtime_api.h>

#include "core/collider/args.h"

namespace gsf::cuda {

template <typename T>
cudaError_t collider_distance(const ColliderDistanceArgs<T>& a, cudaStream_t stream);
template <typename T>
cudaError_t advance_colliders(const AdvanceCollidersArgs<T>& a, cudaStream_t stream);
template <typename T>
cudaError_t blade_sides(const BladeSidesArgs<T>& a, cudaStream_t stream);

}  // namespace gsf::cuda
