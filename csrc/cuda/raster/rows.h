// Rows of spherical-harmonics coefficients between global memory and a thread's registers: a warp
// moves the 32 rows of its Gaussians in consecutive words through shared memory.
#pragma once

#include <type_traits>

#include "core/raster/raster.h"

namespace gsf::cuda {

constexpr int kRowThreads = 128;

// The words that move at once, and rows counted in them.
template <typename T, int kDegree>
struct RowLayout {
  static constexpr int kSize = 3 * sh_coefficients(kDegree);
  static constexpr bool kWide = kSize % 4 == 0 && sizeof(T) == 4;
  using Word = std::conditional_t<kWide, float4, T>;
  static constexpr int kScalars = sizeof(Word) / sizeof(T);
  static constexpr int kWords = kSize / kScalars;
  static constexpr int kStride = kWords | 1;  // odd: lanes that read word j of their rows touch
                                              // different banks
};

// A block's rows in shared memory.
template <typename T, int kDegree>
class SharedRows {
 public:
  using Layout = RowLayout<T, kDegree>;
  using Word = typename Layout::Word;

  // Loads the row of Gaussian `i` (this thread's) into `row`. All lanes must call.
  __device__ __forceinline__ void load(const T* global, int64_t i, bool wanted, T* row) {
    const Word* from = reinterpret_cast<const Word*>(global) + first_word(i);
    for_words(wanted, [&](int step, int at) { words_[at] = from[step * 32]; });
    __syncwarp();
#pragma unroll
    for (int k = 0; k < Layout::kWords; ++k)
      reinterpret_cast<Word*>(row)[k] = words_[threadIdx.x * Layout::kStride + k];
  }

  __device__ __forceinline__ void store(T* global, int64_t i, bool wanted, const T* row) {
    __syncwarp();
#pragma unroll
    for (int k = 0; k < Layout::kWords; ++k)
      words_[threadIdx.x * Layout::kStride + k] = reinterpret_cast<const Word*>(row)[k];
    __syncwarp();
    Word* to = reinterpret_cast<Word*>(global) + first_word(i);
    for_words(wanted, [&](int step, int at) { to[step * 32] = words_[at]; });
  }

 private:
  // This lane's first word of the warp's rows.
  __device__ __forceinline__ static int64_t first_word(int64_t i) {
    const int lane = threadIdx.x % 32;
    return (i - lane) * Layout::kWords + lane;
  }

  // Calls f(step, place in shared memory) for this lane's words of the rows that are wanted.
  template <typename F>
  __device__ __forceinline__ static void for_words(bool wanted, const F& f) {
    const unsigned mask = __ballot_sync(0xffffffffu, wanted);
    const int lane = threadIdx.x % 32, first = threadIdx.x - lane;
#pragma unroll
    for (int step = 0; step < Layout::kWords; ++step) {
      const int word = step * 32 + lane, owner = word / Layout::kWords;
      if (mask >> owner & 1) f(step, (first + owner) * Layout::kStride + word % Layout::kWords);
    }
  }

  Word words_[kRowThreads * Layout::kStride];
};

// Calls f.operator()<degree>(): the degree for which rows go through shared memory, else 0.
template <typename T, typename F>
cudaError_t with_degree(const T* sh, int degree, const F& f) {
  const bool aligned = reinterpret_cast<uintptr_t>(sh) % sizeof(float4) == 0;
  if constexpr (sizeof(T) == sizeof(float)) {
    if (aligned && degree == 1) return f.template operator()<1>();
    if (aligned && degree == 2) return f.template operator()<2>();
    if (aligned && degree == 3) return f.template operator()<3>();
  }
  return f.template operator()<0>();
}

}  // namespace gsf::cuda
