// CUDA kernels of the ops of a texture's synthesis: one thread for a value or a voxel.
#include "cuda/texture/launch.h"
#include "cuda/threads.h"

namespace gsf::cuda {
namespace {

__global__ void rows_between_kernel(RowsBetweenArgs a) {
  const int64_t item = thread_number();
  if (item < a.items()) row_between(a, item);
}

__global__ void quantile_shift_kernel(QuantileShiftArgs a) {
  const int64_t item = thread_number();
  if (item >= a.items()) return;
  const int64_t column = item % a.columns, part = item / a.columns / a.length;
  a.moves[item] = gsf::quantile_shift(
      a.values[item], a.knots, [&](int64_t i) { return a.knot(part, i, column); },
      [&](int64_t i) { return a.move(part, i, column); });
}

__global__ void centers_kernel(PatchVotesArgs a) {
  const int64_t i = thread_number();
  if (i >= a.count) return;
  const int64_t voxel = a.center[i];
  if (voxel >= 0 && voxel < a.voxels) a.row[voxel] = static_cast<int32_t>(i);
}

// A voxel asks, place by place, which patch has it there: sums have the order of the places.
__global__ void votes_kernel(PatchVotesArgs a) {
  const int64_t voxel = thread_number();
  if (voxel >= a.voxels) return;
  float total[3], share;
  bool any = false;
  for (int64_t k = 0; k < a.places; ++k) {
    const int64_t center = voxel - a.offset[k];
    if (center < 0 || center >= a.voxels) continue;
    const int32_t i = a.row[center];
    if (i < 0) continue;
    if (!any) {
      for (int c = 0; c < 3; ++c) total[c] = a.total[3 * voxel + c];
      share = a.share[voxel];
      any = true;
    }
    patch_vote(a, i, k, total, &share);
  }
  if (!any) return;
  for (int c = 0; c < 3; ++c) a.total[3 * voxel + c] = total[c];
  a.share[voxel] = share;
}

}  // namespace

cudaError_t rows_between(const RowsBetweenArgs& a, cudaStream_t stream) {
  rows_between_kernel<<<blocks_for(a.items()), kThreads, 0, stream>>>(a);
  return cudaGetLastError();
}

cudaError_t quantile_shift(const QuantileShiftArgs& a, cudaStream_t stream) {
  quantile_shift_kernel<<<blocks_for(a.items()), kThreads, 0, stream>>>(a);
  return cudaGetLastError();
}

cudaError_t patch_votes(const PatchVotesArgs& a, cudaStream_t stream) {
  const cudaError_t cleared = cudaMemsetAsync(a.row, 0xff, a.voxels * sizeof(int32_t), stream);
  if (cleared != cudaSuccess) return cleared;
  centers_kernel<<<blocks_for(a.count), kThreads, 0, stream>>>(a);
  votes_kernel<<<blocks_for(a.voxels), kThreads, 0, stream>>>(a);
  return cudaGetLastError();
}

}  // namespace gsf::cuda
