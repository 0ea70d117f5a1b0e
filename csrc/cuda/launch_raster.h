// Launchers of the rasterizer's CUDA kernels: torch-free, scratch memory from the caller.
#pragma once

#include <cuda_runtime_api.h>

#include <cstddef>

#include "core/raster.h"

namespace gsf::cuda {

// Project, sort by depth, count instances. On CUDA row i of `splats` belongs to Gaussian i;
// opacity 0 marks one that cannot be seen. `offsets` [N] receives the running instance totals in
// depth order; `*total` (host) their sum. Waits for the stream.
size_t raster_order_scratch(int64_t count);
template <typename T>
cudaError_t raster_order(const RasterArgs<T>& a, void* scratch, size_t bytes, int64_t* offsets,
                         int64_t* total, cudaStream_t stream);

// Fills tile_start and instances, both of the sizes given in the arguments.
size_t raster_bin_scratch(int64_t instances, int64_t tiles);
template <typename T>
cudaError_t raster_bin(const RasterArgs<T>& a, void* scratch, size_t bytes, const int64_t* offsets,
                       cudaStream_t stream);

template <typename T>
cudaError_t raster_blend(const RasterArgs<T>& a, cudaStream_t stream);

// `splat_grads` [N, kGradFeatures + features] must be zeroed by the caller.
template <typename T>
cudaError_t raster_backward(const RasterGradArgs<T>& b, T* splat_grads, cudaStream_t stream);

}  // namespace gsf::cuda
