// CUDA kernels of the spatial ops: one thread for a point or a voxel.
#include "cuda/spatial/launch.h"
#include "cuda/threads.h"

namespace gsf::cuda {
namespace {

__global__ void clear_kernel(NearestLabelsArgs a) {
  const int64_t k = thread_number();
  if (k < a.voxels()) a.best[k] = kNoKey;
}

__global__ void stamp_kernel(NearestLabelsArgs a) {
  const int64_t i = thread_number();
  if (i >= a.count) return;
  // the least key of a voxel does not depend on who comes first
  named_voxels(a, i, 0, a.shape[0], [&](int64_t voxel, int64_t key) {
    if (key < a.best[voxel])
      atomicMin(reinterpret_cast<long long*>(a.best + voxel), static_cast<long long>(key));
  });
}

__global__ void name_kernel(NearestLabelsArgs a) {
  const int64_t k = thread_number();
  if (k < a.voxels()) a.labels[k] = a.label(k);
}

// The block's least and largest of three values each.
__device__ void block_bounds(const float* place, bool counts, float* low, float* high) {
  __shared__ float ends[kThreads / 32][6];
  const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
  for (int axis = 0; axis < 3; ++axis) {
    float least = counts ? place[axis] : HUGE_VALF, most = counts ? place[axis] : -HUGE_VALF;
    for (int step = 16; step; step /= 2) {
      least = fminf(least, __shfl_xor_sync(~0u, least, step));
      most = fmaxf(most, __shfl_xor_sync(~0u, most, step));
    }
    if (lane == 0) {
      ends[warp][axis] = least;
      ends[warp][axis + 3] = most;
    }
  }
  __syncthreads();
  for (int axis = 0; axis < 3; ++axis) {
    low[axis] = HUGE_VALF;
    high[axis] = -HUGE_VALF;
    for (int w = 0; w < kThreads / 32; ++w) {
      low[axis] = fminf(low[axis], ends[w][axis]);
      high[axis] = fmaxf(high[axis], ends[w][axis + 3]);
    }
  }
}

// Places that follow each other are close: a block looks first which fields meet any of its own,
// 256 at a time, and then asks those in order.
__global__ void largest_shares_kernel(LargestSharesArgs a) {
  __shared__ unsigned met[kThreads / 32];
  const int64_t i = thread_number();
  const bool counts = i < a.count;
  float place[3] = {0.0f, 0.0f, 0.0f}, low[3], high[3];
  if (counts) place_of(a, i, place);
  block_bounds(place, counts, low, high);
  TwoLargest found;
  for (int64_t base = 0; base < a.fields; base += kThreads) {
    const int64_t mine = base + threadIdx.x;
    const unsigned bits = __ballot_sync(~0u, mine < a.fields && meets(a, mine, low, high));
    __syncthreads();  // the last words have been read
    if (threadIdx.x % 32 == 0) met[threadIdx.x / 32] = bits;
    __syncthreads();
    for (int word = 0; word < kThreads / 32; ++word)
      for (unsigned left = met[word]; left; left &= left - 1) {
        const int64_t label = base + 32 * word + __ffs(left) - 1;
        if (counts && meets(a, label, place, place)) show(a, label, place, &found);
      }
  }
  if (counts) settle(a, i, found);
}

__global__ void box_sum_kernel(BoxSumArgs a) {
  const int64_t k = thread_number();
  if (k < a.voxels()) a.out[k] = a.sum(k);
}

// A thread for a line. Neighbours of a warp begin side by side but along z, where lines are read
// from the cache.
__global__ void distance_pass_kernel(DistanceArgs a, int64_t lines) {
  const int64_t line = thread_number();
  if (line >= lines) return;
  if (a.axis == 2) return distances_along(a, line);
  const int64_t base = a.first(line);
  envelope_along(int(a.shape[a.axis]), a.stride(), a.square + base,
                 a.source ? a.source + base : nullptr, a.stack + base, a.next_square + base,
                 a.next_source ? a.next_source + base : nullptr);
}

template <typename T>
__global__ void trilinear_kernel(TrilinearArgs<T> a) {
  const int64_t i = thread_number();
  if (i < a.count) gsf::trilinear(a, i);
}

__global__ void value_noise_kernel(ValueNoiseArgs a) {
  const int64_t i = thread_number();
  if (i < a.count) gsf::value_noise(a, i);
}

}  // namespace

cudaError_t nearest_labels(const NearestLabelsArgs& a, cudaStream_t stream) {
  if (a.voxels() == 0) return cudaSuccess;
  clear_kernel<<<blocks_for(a.voxels()), kThreads, 0, stream>>>(a);
  if (a.count) stamp_kernel<<<blocks_for(a.count), kThreads, 0, stream>>>(a);
  name_kernel<<<blocks_for(a.voxels()), kThreads, 0, stream>>>(a);
  return cudaGetLastError();
}

cudaError_t largest_shares(const LargestSharesArgs& a, cudaStream_t stream) {
  if (a.count) largest_shares_kernel<<<blocks_for(a.count), kThreads, 0, stream>>>(a);
  return cudaGetLastError();
}

cudaError_t box_sum(const BoxSumArgs& a, cudaStream_t stream) {
  if (a.voxels()) box_sum_kernel<<<blocks_for(a.voxels()), kThreads, 0, stream>>>(a);
  return cudaGetLastError();
}

cudaError_t distance_pass(const DistanceArgs& a, cudaStream_t stream) {
  const int64_t lines = a.voxels() / a.shape[a.axis];
  distance_pass_kernel<<<blocks_for(lines), kThreads, 0, stream>>>(a, lines);
  return cudaGetLastError();
}

template <typename T>
cudaError_t trilinear(const TrilinearArgs<T>& a, cudaStream_t stream) {
  if (a.count) trilinear_kernel<<<blocks_for(a.count), kThreads, 0, stream>>>(a);
  return cudaGetLastError();
}
template cudaError_t trilinear(const TrilinearArgs<float>&, cudaStream_t);
template cudaError_t trilinear(const TrilinearArgs<double>&, cudaStream_t);

cudaError_t value_noise(const ValueNoiseArgs& a, cudaStream_t stream) {
  if (a.count) value_noise_kernel<<<blocks_for(a.count), kThreads, 0, stream>>>(a);
  return cudaGetLastError();
}

}  // namespace gsf::cuda
