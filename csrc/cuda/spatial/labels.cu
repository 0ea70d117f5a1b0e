// CUDA kernels of core/labels.h: one thread for a value, a voxel or a pair.
#include "cuda/spatial/launch.h"
#include "cuda/threads.h"

namespace gsf::cuda {
namespace {

__global__ void hashes_kernel(HashesArgs a) {
  const int64_t k = thread_number();
  if (k < a.count * a.turns) hash_one(a, k);
}

__global__ void no_box_kernel(LabelBoxesArgs a) {
  const int64_t k = thread_number();
  if (k < 6 * a.count) a.box[k] = a.none(k);
}

__global__ void label_boxes_kernel(LabelBoxesArgs a) {
  const int64_t k = thread_number();
  if (k >= a.voxels()) return;
  const int64_t label = a.labels[k];
  if (label < 0 || label >= a.count) return;
  const int64_t line = k / a.shape[2];
  const int place[3] = {int(line / a.shape[1]), int(line % a.shape[1]), int(k % a.shape[2])};
  int32_t* box = a.box + 6 * label;
  for (int axis = 0; axis < 3; ++axis) {
    // few look twice: the ends are soon where they stay
    if (place[axis] < box[2 * axis]) atomicMin(box + 2 * axis, place[axis]);
    if (place[axis] > box[2 * axis + 1]) atomicMax(box + 2 * axis + 1, place[axis]);
  }
}

constexpr int kHeld = 2048;  // counts that a block keeps to itself

__global__ void margin_counts_kernel(MarginCountsArgs a) {
  __shared__ unsigned held[kHeld];
  const bool few = 2 * a.labels <= kHeld;
  if (few)
    for (int k = threadIdx.x; k < 2 * a.labels; k += blockDim.x) held[k] = 0;
  __syncthreads();
  const int64_t i = thread_number();
  auto* found = reinterpret_cast<unsigned long long*>(a.found);
  if (i < a.count)
    margin_counts(a, i, [&](int64_t k) {
      if (few)
        atomicAdd(held + k, 1u);
      else
        atomicAdd(found + k, 1ull);
    });
  __syncthreads();
  if (few)
    for (int k = threadIdx.x; k < 2 * a.labels; k += blockDim.x)
      if (held[k]) atomicAdd(found + k, static_cast<unsigned long long>(held[k]));
}

}  // namespace

cudaError_t hashes(const HashesArgs& a, cudaStream_t stream) {
  const int64_t count = a.count * a.turns;
  if (count) hashes_kernel<<<blocks_for(count), kThreads, 0, stream>>>(a);
  return cudaGetLastError();
}

cudaError_t label_boxes(const LabelBoxesArgs& a, cudaStream_t stream) {
  if (a.count) no_box_kernel<<<blocks_for(6 * a.count), kThreads, 0, stream>>>(a);
  if (a.voxels()) label_boxes_kernel<<<blocks_for(a.voxels()), kThreads, 0, stream>>>(a);
  return cudaGetLastError();
}

cudaError_t margin_counts(const MarginCountsArgs& a, cudaStream_t stream) {
  if (a.count) margin_counts_kernel<<<blocks_for(a.count), kThreads, 0, stream>>>(a);
  return cudaGetLastError();
}

}  // namespace gsf::cuda
