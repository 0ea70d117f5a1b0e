// Sums and maxima over a CTA of the resident solver's kernels; look-ups in its hash table.
#pragma once

#include "cuda/solver/launch.h"

namespace gsf::cuda {

constexpr unsigned kAllLanes = 0xffffffffu;

// Bits of a non-negative value, so that NaN sorts above all others.
__device__ inline unsigned sortable(float value) {
  return value >= 0.0f ? __float_as_uint(value) : (value < 0.0f ? 0u : 0x7fffffffu);
}

// Largest of each of the kValues values over the CTA, as sortable bits; valid in thread 0.
template <int kThreadsHere, int kValues>
__device__ inline void block_largest(const float (&values)[kValues], unsigned (&out)[kValues]) {
  __shared__ unsigned warps[kValues][kThreadsHere / 32];
  for (int i = 0; i < kValues; ++i) {
    const unsigned largest = __reduce_max_sync(kAllLanes, sortable(values[i]));
    if ((threadIdx.x & 31) == 0) warps[i][threadIdx.x / 32] = largest;
  }
  __syncthreads();
  if (threadIdx.x != 0) return;
  for (int i = 0; i < kValues; ++i) {
    out[i] = 0;
    for (int w = 0; w < kThreadsHere / 32; ++w)
      out[i] = out[i] > warps[i][w] ? out[i] : warps[i][w];
  }
}

// The end of a CTA without a barrier: every warp adds its maxima and leaves; the last one goes on
// with those of all.
template <int kValues>
struct CtaEnd {
  unsigned largest[kValues];
  int done;

  __device__ void clear() {
    if (threadIdx.x < kValues) largest[threadIdx.x] = 0;
    if (threadIdx.x == kValues) done = 0;
  }
  // Called by whole warps; true in the last one.
  __device__ bool leave(const float (&values)[kValues], unsigned (&out)[kValues]) {
    const int lane = threadIdx.x & 31;
    for (int i = 0; i < kValues; ++i) {
      const unsigned most = __reduce_max_sync(kAllLanes, sortable(values[i]));
      if (lane == i && most > 0u) atomicMax(largest + i, most);
    }
    __threadfence_block();
    __syncwarp();
    int before = lane == 0 ? atomicAdd(&done, 1) : 0;
    before = __shfl_sync(kAllLanes, before, 0);
    if (before + 1 < int(blockDim.x) / 32) return false;
    __threadfence_block();
    for (int i = 0; i < kValues; ++i) out[i] = *static_cast<volatile unsigned*>(largest + i);
    return true;
  }
};

__device__ inline void raise_to(uint64_t* word, unsigned bits) {
  if (bits > 0u && *reinterpret_cast<volatile unsigned long long*>(word) < bits)
    atomicMax(reinterpret_cast<unsigned long long*>(word), static_cast<unsigned long long>(bits));
}

// Maximum of non-negative reals: their bits sort like integers.
__device__ inline void raise_real(float* p, float v) {
  atomicMax(reinterpret_cast<unsigned*>(p), __float_as_uint(v));
}
__device__ inline void raise_real(double* p, double v) {
  atomicMax(reinterpret_cast<unsigned long long*>(p),
            static_cast<unsigned long long>(__double_as_longlong(v)));
}

// Bits of sqrt(x) rounded up a little, for values that were compared as squares.
__device__ inline unsigned root_up(unsigned bits) {
  if (bits >= 0x7f800000u) return 0x7fffffffu;
  return __float_as_uint(sqrtf(__uint_as_float(bits)) * 1.0000003f);
}

// Adds the lanes that say yes to a counter.
__device__ inline void count_lanes(bool yes, int64_t* counter) {
  const unsigned mask = __ballot_sync(kAllLanes, yes);
  if (mask != 0u && (threadIdx.x & 31) == 0)
    atomicAdd(reinterpret_cast<unsigned long long*>(counter),
              static_cast<unsigned long long>(__popc(mask)));
}

// Called by one warp of a CTA; true in all its lanes when it is the last of `total` to arrive. What
// was written by atomics before is visible to it; what particles hold is the next kernel's matter.
__device__ inline bool last_to_arrive(int64_t* arrived, int64_t total) {
  bool last = false;
  if ((threadIdx.x & 31) == 0) {
    __threadfence();
    const unsigned long long before =
        atomicAdd(reinterpret_cast<unsigned long long*>(arrived), 1ull);
    last = before + 1 == static_cast<unsigned long long>(total);
    if (last) *arrived = 0;
    __threadfence();
  }
  return __shfl_sync(kAllLanes, int(last), 0) != 0;
}

// Entry of a key in the hash table, -1 when it has none.
template <typename T>
__device__ int32_t find(const SolverView<T>& s, uint64_t key) {
  const uint64_t mask = uint64_t(s.table_size) - 1;
  uint64_t at = hash_key(key) & mask;
  for (int64_t tries = 0; tries < s.table_size; ++tries, at = (at + 1) & mask) {
    if (s.key[at] == key) return static_cast<int32_t>(at);
    if (s.key[at] == kNoKey) return -1;
  }
  return -1;
}

// Slot of the field of block `c` (three coordinates, field) in block n of the 27 around it, or -1.
// The table keeps its slots until the blocks are built anew.
template <typename T>
__device__ int32_t slot_around(const SolverView<T>& s, const int32_t* c, int n) {
  const int32_t e =
      find(s, block_key(c[0] + n / 9 - 1, c[1] + n / 3 % 3 - 1, c[2] + n % 3 - 1, c[3]));
  return e >= 0 && s.table_slot[e] >= 0 ? s.table_slot[e] : -1;
}

// Largest momentum bound and mass of the particles of one home.
template <typename T>
__device__ void home_bounds(const SolverView<T>& s, int64_t home, int64_t first, int64_t count) {
  float bound = 0.0f, mass = 0.0f;
  for (int64_t r = threadIdx.x; r < count; r += kSolverThreads) {
    const int64_t p = first + r;
    const T m = s.rows[int64_t(s.row_of(load_meta(s, p))) * kRowColumns + kMassColumn];
    T velocity[3], slope[9];
    load_motion(s, p, velocity, slope);
    bound = larger(float(momentum_bound(velocity, slope, m, s.dx)), bound);
    if (s.own != nullptr) {
      load_nine(s, s.own, p, slope);
      bound = larger(float(momentum_bound(velocity, slope, m, s.dx)), bound);
    }
    mass = larger(float(m), mass);
  }
  const float values[2] = {bound, mass};
  unsigned largest[2];
  block_largest<kSolverThreads>(values, largest);
  if (threadIdx.x == 0) {
    s.home_bound[home] = T(__uint_as_float(largest[0])) * T(1.000001);
    s.home_mass[home] = T(__uint_as_float(largest[1])) * T(1.000001);
  }
}

}  // namespace gsf::cuda
