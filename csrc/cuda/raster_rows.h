// Rows of spherical-harmonics coefficients between global memory and a thread: a warp moves the 32
// rows of its Gaussians in consecutive words through shared memory.
#pragma once

#include "core/raster.h"

namespace gsf::cuda {

constexpr int kRowThreads = 128;

constexpr int row_size(int degree) { return 3 * sh_coefficients(degree); }
// Odd, so that 32 lanes reading word j of their rows touch 32 banks.
constexpr int row_stride(int degree) { return row_size(degree) | 1; }

// Calls f(word, row offset in shared memory) for the words of the warp's rows that are `wanted`.
template <int kDegree, typename F>
__device__ __forceinline__ void for_row_words(int64_t i, bool wanted, const F& f) {
  constexpr int kSize = row_size(kDegree);
  const unsigned mask = __ballot_sync(0xffffffffu, wanted);
  const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
  const int64_t first = (i - lane) * kSize;
#pragma unroll
  for (int step = 0; step < kSize; ++step) {
    const int word = step * 32 + lane, owner = word / kSize;
    if (mask >> owner & 1)
      f(first + word, (warp * 32 + owner) * row_stride(kDegree) + word % kSize);
  }
}

// Loads the rows of the warp's Gaussians; `i` is this thread's, its row is the one returned. All
// lanes must call.
template <typename T, int kDegree>
__device__ __forceinline__ T* load_rows(const T* global, int64_t i, bool wanted, T* shared) {
  for_row_words<kDegree>(i, wanted, [&](int64_t word, int at) { shared[at] = global[word]; });
  __syncwarp();
  return shared + threadIdx.x * row_stride(kDegree);
}

template <typename T, int kDegree>
__device__ __forceinline__ void store_rows(T* global, int64_t i, bool wanted, const T* shared) {
  __syncwarp();
  for_row_words<kDegree>(i, wanted, [&](int64_t word, int at) { global[word] = shared[at]; });
}

// Calls f.operator()<degree>(): the degree for which rows go through shared memory, else 0.
template <typename T, typename F>
cudaError_t with_degree(const RasterArgs<T>& a, const F& f) {
  if constexpr (sizeof(T) == sizeof(float)) {
    if (a.sh_degree == 1) return f.template operator()<1>();
    if (a.sh_degree == 2) return f.template operator()<2>();
    if (a.sh_degree == 3) return f.template operator()<3>();
  }
  return f.template operator()<0>();
}

}  // namespace gsf::cuda
