// Kernels with one thread for an item: how many blocks they take, and the item of a thread.
#pragma once

#include <cstdint>

namespace gsf::cuda {

constexpr int kThreads = 256;     // of a block
constexpr int kFewThreads = 128;  // where an item takes many registers

template <int kPerBlock = kThreads>
unsigned blocks_for(int64_t items) {
  return static_cast<unsigned>((items + kPerBlock - 1) / kPerBlock);
}

template <int kPerBlock = kThreads>
__device__ int64_t thread_number() {
  return int64_t(blockIdx.x) * kPerBlock + threadIdx.x;
}

}  // namespace gsf::cuda
