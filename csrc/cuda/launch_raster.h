// Launchers of the rasterizer's CUDA kernels: torch-free, scratch memory from the caller.
#pragma once

#include <cuda_runtime_api.h>

#include <cstddef>

#include "core/raster.h"

namespace gsf::cuda {

// Per splat, in scratch memory: sort keys, the splats by depth, and how many entries of the lists
// each needs.
struct RasterOrder {
  uint32_t* keys;     // [M] depth
  int32_t* ids;       // [M] 0, 1, ...
  uint32_t* sorted;   // [M]
  int32_t* order;     // [M] splats, nearest first
  uint32_t* counts;   // [M] tiles of splat m
  uint32_t* offsets;  // [M] tiles of the splats before rank r
  unsigned long long* total;
  void* temporary;
  size_t temporary_bytes;
};
size_t raster_order_scratch(int64_t splats);
RasterOrder carve_raster_order(void* scratch, int64_t splats);

// A number on its way to the host. One per thread and device, kept for the life of the process.
class ReadBack;
ReadBack* read_back(int device);

// Projects: fills splats, radii, keys, ids, counts; sends the sum of counts to `number`.
template <typename T>
cudaError_t raster_project(const RasterArgs<T>& a, const RasterOrder& o, ReadBack* number,
                           cudaStream_t stream);
// Sorts by depth and sums up the counts: fills order and offsets.
cudaError_t raster_sort(const RasterOrder& o, int64_t splats, cudaStream_t stream);
// Waits for the number of list entries.
cudaError_t await_count(ReadBack* number, int64_t* count);

// Fills tile_start and instances, both of the sizes given in the arguments.
size_t raster_bin_scratch(int64_t instances, int64_t tiles);
template <typename T>
cudaError_t raster_bin(const RasterArgs<T>& a, const RasterOrder& o, void* scratch, size_t bytes,
                       cudaStream_t stream);

template <typename T>
cudaError_t raster_blend(const RasterArgs<T>& a, cudaStream_t stream);

// Sums of a splat over the pixels: moments, the gradients of the first `active` features, and, when
// wanted, the absolute gradients of the centre; `stride` numbers from splat to splat.
template <typename T>
struct SplatSums {
  T* data;
  int stride;
  int active;
};
template <typename T>
SplatSums<T> raster_sums(const RasterGradArgs<T>& b);  // data null: the caller brings memory
// Fills every gradient but the background's, which it adds to.
template <typename T>
cudaError_t raster_backward(const RasterGradArgs<T>& b, const SplatSums<T>& sums,
                            cudaStream_t stream);
// Its last part: from the sums to the inputs.
template <typename T>
cudaError_t raster_gaussian_backward(const RasterGradArgs<T>& b, const SplatSums<T>& sums,
                                     cudaStream_t stream);

}  // namespace gsf::cuda
