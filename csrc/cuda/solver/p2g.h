// Particles to nodes: one CTA per home, its window of 8^3 nodes in shared memory. Sums are
// integers: in the window 32 bits (float state) in a unit of the home, between windows 64 bits in a
// unit of the step. Each addend is rounded once, to the unit of its home, and both are powers of
// two, the first never the finer: no order of additions changes a bit, nor does it matter which CTA
// adds what. The units leave room for every particle at one node (csrc/core/solver/clock.h), so
// nothing overflows.
#pragma once

#include "cuda/solver/grid.h"

namespace gsf::cuda {
namespace {

// Threads of a CTA, and CTAs of a multiprocessor that registers must suffice for: measured on an
// H100 (docs/measured/benchmarks.md).
constexpr int kP2GThreads = 128, kP2GCtas = 8;
// Strides of the window in shared memory: 32 cells of half a block lie in 32 different banks.
constexpr int kStrideX = 68, kStrideY = 8;
constexpr int kTile = kWindowEdge * kStrideX;

template <typename T>
struct Fixed;
template <>
struct Fixed<float> {
  using Word = int;
  static constexpr int kBits = 30;
  static __device__ Word round(float v) { return __float2int_rn(v); }
  static __device__ void add(Word* p, Word v) { atomicAdd(p, v); }
};
template <>
struct Fixed<double> {
  using Word = long long;
  static __device__ Word round(double v) { return __double2ll_rn(v); }
  static __device__ void add(Word* p, Word v) {
    atomicAdd(reinterpret_cast<unsigned long long*>(p), static_cast<unsigned long long>(v));
  }
};

// Unit of a window: `count` contributions of at most `bound` fit into 2^kBits of it. Never finer
// than the unit of the step, which the double window uses itself: two CTAs may share a home, and
// which of them takes a point is chance, so what each hands over must be exact. No digits are lost
// that a node could have kept: the step's unit is 2^-unit_bits of the largest bound of all points
// (43 bits at 10^6 points), and is the coarser one only where all of a home is 0.43 count
// 2^(unit_bits - 30) times slower (10^6 in a full home). Each addend is off by half a unit of the
// step there, where the sum of the window was before.
template <typename T>
__device__ double window_unit(double bound, double share, int64_t count, double step_unit) {
  if constexpr (sizeof(T) == 8)
    return step_unit;
  else
    return fmax(ldexp(power_above(fmax(bound, 1e-25) * share * double(count)), -Fixed<T>::kBits),
                step_unit);
}

__device__ int window_node(int index, int& i, int& j, int& k) {
  i = index >> 6;
  j = index >> 3 & 7;
  k = index & 7;
  return i * kStrideX + j * kStrideY + k;
}

// Index in the window of the first node of a particle's stencil. Cells are at most kLastCell by
// construction; garbage cells stay inside the window too.
__device__ int window_base(uint32_t meta) {
  return min(meta_cell(meta, 0), kLastCell) * kStrideX +
         min(meta_cell(meta, 1), kLastCell) * kStrideY + min(meta_cell(meta, 2), kLastCell);
}

__device__ int neighbour_of(int i, int j, int k) {
  return (window_block(i) * 3 + window_block(j)) * 3 + window_block(k);
}

// Slot and node inside it of window node (i, j, k); -1 when no slot is there.
__device__ int64_t slot_node(const int32_t* neighbour, int i, int j, int k) {
  const int32_t slot = neighbour[neighbour_of(i, j, k)];
  if (slot < 0) return -1;
  return int64_t(slot) * kBlockNodes +
         local_index(window_local(i), window_local(j), window_local(k));
}

// Small scenes give a home to several CTAs, so that each does less in a row: 2^shift of them.
template <typename T>
int split_shift(const SolverView<T>& s) {
  return s.count < 600000 ? 1 : 0;
}

// Words of a window times 2^shift (shift >= 0, see window_unit) are units of the step: exact.
template <typename Word>
__device__ long long to_units(Word word, int shift) {
  return static_cast<long long>(word) << shift;
}

// Units of the window of a home.
template <typename T>
struct WindowUnits {
  T per_momentum, per_mass;        // 1 / unit
  int momentum_shift, mass_shift;  // to units of the step

  __device__ void choose(const SolverView<T>& s, int64_t home, int64_t count) {
    const SolverClock& clock = *s.clock;
    const double unit = window_unit<T>(s.home_bound[home], 0.43, count, clock.momentum_unit);
    const double mass = window_unit<T>(s.home_mass[home], 0.43, count, clock.mass_unit);
    per_momentum = T(1.0 / unit);
    per_mass = T(1.0 / mass);
    momentum_shift = ilogb(unit) - ilogb(clock.momentum_unit);
    mass_shift = ilogb(mass) - ilogb(clock.mass_unit);
  }
};

// What one particle gives, as read.
template <typename T>
struct ParticleGiven {
  T offset[3], velocity[3], slope[9];
  uint32_t meta;

  template <bool kFree>
  __device__ void read(const SolverView<T>& s, int64_t p) {
    meta = load_place(s, p, offset);
    if constexpr (kFree) {
      load_speed(s, p, velocity);
      load_nine(s, s.own, p, slope);
    } else {
      load_motion(s, p, velocity, slope);
    }
  }
};

// Calls f(view) of the other ranks among these bits.
template <typename T, typename F>
__device__ __forceinline__ void for_others_of(const SolverView<T>& s, uint64_t ranks, const F& f) {
  if (ranks != 0) ranks &= ~(uint64_t(1) << s.rank);
  for (; ranks != 0; ranks &= ranks - 1) f(s.peers[__ffsll(static_cast<long long>(ranks)) - 1]);
}

// Adds units(c) to the `kWords` sums of a node: on this rank, and on all others that hold its slot
// (sums(view) = their array).
template <int kWords, typename T, typename Units, typename Sums>
__device__ __forceinline__ void give_node(const SolverView<T>& s, int64_t node, const Units& units,
                                          const Sums& sums) {
  const uint64_t holders = s.peers == nullptr ? 0 : s.holders[node / kBlockNodes];
  for (int c = 0; c < kWords; ++c) {
    const long long v = units(c);
    if (v == 0) continue;
    add_units(sums(s) + kWords * node + c, v);
    for_others_of(s, holders,
                  [&](const SolverView<T>& other) { add_far(sums(other) + kWords * node + c, v); });
  }
}

// One home, or part of it. Where its window touches blocks that fields share, moments are summed
// too. kFree: without the forces, from `own`.
template <typename T, bool kMoments, bool kFree = false>
__device__ __forceinline__ void p2g_home(const SolverView<T>& s, int64_t home, int part,
                                         int split_shift) {
  using Word = typename Fixed<T>::Word;
  constexpr int kChannels = kMoments ? 4 + kContactMoments : 4;
  __shared__ Word tile[kChannels][kTile];
  __shared__ int32_t neighbour[kNeighbours];
  __shared__ bool slot_shared[kMoments ? kNeighbours : 1];
  __shared__ WindowUnits<T> units;
  const HomeList<T>& homes = s.homes();
  const int64_t first = homes.start[home];
  const int64_t count = min(int64_t(homes.count[home]), s.count - first);
  const int stride = kP2GThreads << split_shift;
  int64_t r = part * kP2GThreads + threadIdx.x;
  ParticleGiven<T> given;
  if (first >= 0 && r < count)
    given.template read<kFree>(s, first + r);  // while the window is cleared
  for (int i = threadIdx.x; i < kChannels * kTile; i += kP2GThreads) (&tile[0][0])[i] = 0;
  if (threadIdx.x < kNeighbours) {
    const int32_t slot = s.neighbour[home * kNeighbours + threadIdx.x];
    neighbour[threadIdx.x] = slot < s.slot_capacity ? slot : -1;
    if constexpr (kMoments)
      slot_shared[threadIdx.x] = neighbour[threadIdx.x] >= 0 && s.slot_shared[slot] != 0;
  }
  if (threadIdx.x == kP2GThreads - 1) units.choose(s, home, count);
  __syncthreads();
  const T per_unit = units.per_momentum, per_mass = units.per_mass;
  while (first >= 0 && r < count) {
    const T mass = s.rows[int64_t(s.row_of(given.meta)) * kRowColumns + kMassColumn];
    const Stencil<T> st = stencil_at(given.offset);
    ParticleMomentum<T> q = momentum_given(st, given.velocity, given.slope, mass, s.dx);
    for (int i = 0; i < 3; ++i) q.constant[i] *= per_unit;
    for (int i = 0; i < 9; ++i) q.slope.m[i] *= per_unit;
    const T weight_unit = mass * per_mass;
    const int base = window_base(given.meta);
    for_each_node([&](int i, int j, int k) {
      const T w = st.weight(i, j, k);
      const int at = base + i * kStrideX + j * kStrideY + k;
#pragma unroll
      for (int c = 0; c < 3; ++c)
        Fixed<T>::add(&tile[c][at],
                      Fixed<T>::round(w * (q.constant[c] + q.slope(c, 0) * T(i) +
                                           q.slope(c, 1) * T(j) + q.slope(c, 2) * T(k))));
      Fixed<T>::add(&tile[3][at], Fixed<T>::round(w * weight_unit));
      if constexpr (kMoments) {
        const Vec3<T> g = contact_moment(st, w * weight_unit, i, j, k);
        for (int c = 0; c < kContactMoments; ++c)
          Fixed<T>::add(&tile[4 + c][at], Fixed<T>::round(g[c]));
      }
    });
    r += stride;
    if (r < count) given.template read<kFree>(s, first + r);
  }
  __syncthreads();
  const int momentum_shift = units.momentum_shift, mass_shift = units.mass_shift;
  for (int index = threadIdx.x; index < kWindowNodes; index += kP2GThreads) {
    int i, j, k;
    const int at = window_node(index, i, j, k);
    // All channels: the mass of a part of the home may round to nothing where others do not.
    Word any = tile[0][at] | tile[1][at] | tile[2][at] | tile[3][at];
    if constexpr (kMoments) any |= tile[4][at] | tile[5][at] | tile[6][at];
    if (any == 0) continue;
    const int64_t node = slot_node(neighbour, i, j, k);
    if (node < 0) continue;
    give_node<4>(
        s, node, [&](int c) { return to_units(tile[c][at], c < 3 ? momentum_shift : mass_shift); },
        [](const SolverView<T>& v) { return static_cast<int64_t*>(v.sums); });
    if constexpr (kMoments) {
      // Only shared slots: nobody would clear the moments of the others.
      if (slot_shared[neighbour_of(i, j, k)])
        give_node<kContactMoments>(
            s, node, [&](int c) { return to_units(tile[4 + c][at], mass_shift); },
            [](const SolverView<T>& v) { return static_cast<int64_t*>(v.moments); });
    }
  }
}

template <typename T>
__global__ void __launch_bounds__(kP2GThreads, kP2GCtas)
    p2g_kernel(const __grid_constant__ SolverView<T> s, int split_shift) {
  const SolverClock& clock = *s.clock;
  // Backwards: what g2p wrote last is still in the cache.
  const int64_t home = clock.homes - 1 - (blockIdx.x >> split_shift);
  if (!may_step(clock) || home < 0) return;
  if (s.moments != nullptr && s.place[home] != 0) return;  // p2g_shared_kernel's
  p2g_home<T, false>(s, home, blockIdx.x & ((1 << split_shift) - 1), split_shift);
}

// The homes that touch shared blocks; bound_kernel has listed them in `entry`. Few CTAs, because
// most scenes have few such homes.
template <typename T>
__global__ void __launch_bounds__(kP2GThreads, kP2GCtas)
    p2g_shared_kernel(const __grid_constant__ SolverView<T> s, int split_shift) {
  const SolverClock& clock = *s.clock;
  if (!may_step(clock)) return;
  const int64_t work = clock.shared_homes << split_shift;
  for (int64_t i = blockIdx.x; i < work; i += gridDim.x) {
    p2g_home<T, true>(s, s.entry[i >> split_shift], static_cast<int>(i & ((1 << split_shift) - 1)),
                      split_shift);
    __syncthreads();  // the window is used again
  }
}

}  // namespace
}  // namespace gsf::cuda
