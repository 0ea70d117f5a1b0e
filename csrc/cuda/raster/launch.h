// Launchers of the rasterizer's CUDA kernels: torch-free, scratch memory from the caller.
#pragma once

#include <cuda_runtime_api.h>

#include <cstddef>

#include "core/raster/raster.h"

namespace gsf::cuda {

// Edge of a list's tile [px]. Warps cull splats for their own 8x8 pixels, so the lists may be
// coarse: at 32 there are 2.3 times fewer entries to write and sort than at 16.
constexpr int kListTile = 32;
constexpr int kGeometry = 8;  // numbers per splat before its features

// Per splat, in scratch memory: sort keys, the splats by depth, and how many entries of the lists
// each needs.
struct RasterOrder {
  uint32_t* keys;     // [M] depth
  int32_t* ids;       // [M] 0, 1, ...
  uint32_t* sorted;   // [M]
  int32_t* order;     // [M] splats, nearest first
  uint64_t* codes;    // [M] tiles of splat m (TileCode)
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

// Projects: fills splats, radii, keys, ids, codes; sends the number of tiles to `number`.
template <typename T>
cudaError_t raster_project(const RasterArgs<T>& a, const RasterOrder& o, ReadBack* number,
                           cudaStream_t stream);
// Sorts by depth and sums up the tiles: fills order and offsets.
cudaError_t raster_sort(const RasterOrder& o, int64_t splats, cudaStream_t stream);
// Waits for the number of list entries.
cudaError_t await_count(ReadBack* number, int64_t* count);

// Fills tile_start and instances, both of the sizes given in the arguments.
size_t raster_bin_scratch(int64_t instances, int64_t tiles);
template <typename T>
cudaError_t raster_bin(const RasterArgs<T>& a, const RasterOrder& o, void* scratch, size_t bytes,
                       cudaStream_t stream);

// `units`: [N] words for the sums of blend weights, when those are wanted. They are whole numbers,
// so that the order of the warps changes no bit.
template <typename T>
cudaError_t raster_blend(const RasterArgs<T>& a, int64_t* units, cudaStream_t stream);

// Sums of a splat over the pixels: moments, the absolute gradients of the centre when wanted, and
// the gradients of the first `active` features. Word k of splat m stands in one of up to three
// arrays, because those of few words are summed right where the gradients of means, quats and
// scales (or covars) will be: the thread that reads them writes those.
template <typename T>
struct SplatSums {
  static constexpr int kParts = 3;
  T* part[kParts];
  int stride[kParts];
  int end[kParts];  // first word that is not in the part
  int active;
  int features;  // word of the first feature
  // Order-free sums of the same words (core/raster/order_free.h): kBounds numbers whose bits say
  // how large an addend can be, then a coarse and a fine word for each of [M, width()]. They are
  // rounded to the words above at the end. Null: floats are added there at once.
  static constexpr int kBounds = 4;
  int64_t* fixed;

  GSF_HOST_DEVICE int width() const { return features + active; }
  // Written without indices that change: those would put the struct into local memory.
  GSF_HOST_DEVICE int stride_of(int k) const {
    return k < end[0] ? stride[0] : (k < end[1] ? stride[1] : stride[2]);
  }
  GSF_HOST_DEVICE T* word(int k, int64_t m) const {
    T* base = k < end[0] ? part[0] : (k < end[1] ? part[1] : part[2]);
    const int before = k < end[0] ? 0 : (k < end[1] ? end[0] : end[1]);
    return base + m * stride_of(k) + (k - before);
  }
};
// Numbers of memory of their own that the sums need; 0 when the gradients' will do.
template <typename T>
int64_t raster_sums_size(const RasterGradArgs<T>& b);
// Whole numbers that order-free sums need beside; 0 when not asked for.
template <typename T>
int64_t raster_fixed_size(const RasterGradArgs<T>& b);
template <typename T>
SplatSums<T> raster_sums(const RasterGradArgs<T>& b, T* own, int64_t* fixed);
// Numbers that the gradient of the background needs, 0 without.
template <typename T>
int64_t raster_background_size(const RasterGradArgs<T>& b);
// Fills every gradient but the background's, which it adds to.
template <typename T>
cudaError_t raster_backward(const RasterGradArgs<T>& b, const SplatSums<T>& sums, T* background,
                            cudaStream_t stream);
// Its last part: from the sums to the inputs.
template <typename T>
cudaError_t raster_gaussian_backward(const RasterGradArgs<T>& b, const SplatSums<T>& sums,
                                     cudaStream_t stream);

}  // namespace gsf::cuda
