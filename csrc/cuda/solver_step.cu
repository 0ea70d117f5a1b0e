// One step of the resident solver on the GPU. p2g and g2p: one CTA per home, its window of 8^3
// nodes in shared memory. Sums are integers: in the window 32 bits (float state) in a unit of the
// home, between windows 64 bits in a unit of the step, so that no order of additions changes a bit.
// The units leave room for every particle at one node (csrc/core/solver_clock.h), so nothing
// overflows.
#include "cuda/solver_grid.h"

namespace gsf::cuda {
namespace {

constexpr int kThreads = kSolverThreads;
// Threads of a CTA, and CTAs of a multiprocessor that registers must suffice for: measured on an
// H100 (docs/benchmarks.md).
constexpr int kP2GThreads = 128, kP2GCtas = 8;
constexpr int kG2PThreads = 256, kG2PCtas = 3;
constexpr unsigned kSharedCtas = 2048;  // of the kernels that only shared blocks need
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

// Unit of a window: `count` contributions of at most `bound` fit into 2^kBits of it. The double
// window uses the unit of the step itself.
template <typename T>
__device__ double window_unit(double bound, double share, int64_t count, double step_unit) {
  if constexpr (sizeof(T) == 8)
    return step_unit;
  else
    return ldexp(power_above(fmax(bound, 1e-25) * share * double(count)), -Fixed<T>::kBits);
}

// Brings the line at p near; nothing waits for it.
__device__ inline void prefetch(const void* p) {
  asm volatile("prefetch.global.L1 [%0];" ::"l"(p));
}

__device__ int window_node(int index, int& i, int& j, int& k) {
  i = index >> 6;
  j = index >> 3 & 7;
  k = index & 7;
  return i * kStrideX + j * kStrideY + k;
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

// Words of a window times 2^shift are units of the step: exact for shift >= 0.
template <typename Word>
__device__ long long to_units(Word word, int shift) {
  if (shift >= 0) return static_cast<long long>(word) << shift;
  return __double2ll_rn(ldexp(double(word), shift));
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

  __device__ void read(const SolverView<T>& s, int64_t p) {
    meta = load_place(s, p, offset);
    load_motion(s, p, velocity, slope);
  }
};

// One home, or part of it. Where its window touches blocks that fields share, moments are summed
// too.
template <typename T, bool kMoments>
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
  if (first >= 0 && r < count) given.read(s, first + r);  // while the window is cleared
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
    const uint32_t row = meta_row(given.meta) < uint64_t(s.row_count) ? meta_row(given.meta) : 0;
    const T mass = s.rows[int64_t(row) * kRowColumns + kMassColumn];
    const Stencil<T> st = stencil_at(given.offset);
    ParticleMomentum<T> q = momentum_given(st, given.velocity, given.slope, mass, s.dx);
    for (int i = 0; i < 3; ++i) q.constant[i] *= per_unit;
    for (int i = 0; i < 9; ++i) q.slope.m[i] *= per_unit;
    const T weight_unit = mass * per_mass;
    // Cells are at most kLastCell by construction; garbage cells stay inside the window too.
    const int base = min(meta_cell(given.meta, 0), kLastCell) * kStrideX +
                     min(meta_cell(given.meta, 1), kLastCell) * kStrideY +
                     min(meta_cell(given.meta, 2), kLastCell);
#pragma unroll
    for (int i = 0; i < 3; ++i)
#pragma unroll
      for (int j = 0; j < 3; ++j)
#pragma unroll
        for (int k = 0; k < 3; ++k) {
          const T w = st.w[0][i] * st.w[1][j] * st.w[2][k];
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
        }
    r += stride;
    if (r < count) given.read(s, first + r);
  }
  __syncthreads();
  int64_t* sums = static_cast<int64_t*>(s.sums);
  int64_t* moments = static_cast<int64_t*>(s.moments);
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
    for (int c = 0; c < 4; ++c) {
      const long long v = to_units(tile[c][at], c < 3 ? momentum_shift : mass_shift);
      if (v != 0) add_units(sums + 4 * node + c, v);
    }
    if constexpr (kMoments) {
      // Only shared slots: nobody would clear the moments of the others.
      if (slot_shared[neighbour_of(i, j, k)])
        for (int c = 0; c < kContactMoments; ++c) {
          const long long v = to_units(tile[4 + c][at], mass_shift);
          if (v != 0) add_units(moments + kContactMoments * node + c, v);
        }
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

// Maxima of a step, for the clock and the home. One warp calls.
template <typename T>
__device__ void hand_over(const SolverView<T>& s, const unsigned (&bits)[4], int64_t home,
                          bool moving) {
  if ((threadIdx.x & 31) != 0) return;
  SolverClock& c = *s.clock;
  if (moving) {
    raise_to(&c.speed, root_up(bits[0]));
    raise_to(&c.wave, root_up(bits[1]));
    raise_to(&c.gradient, root_up(bits[2]));
  }
  if (home >= 0) {
    const float bound = __uint_as_float(bits[3]) * 1.000002f;
    raise_real(s.home_bound + home, T(bound));
    raise_to(&c.bound, __float_as_uint(bound));
  }
}

// What the last warp of a step does: colliders move on, then time. Out of line, so that g2p does
// not hold its registers.
template <typename T>
__device__ __noinline__ void end_of_step(const SolverView<T>& s) {
  const int lane = threadIdx.x & 31;
  for (int64_t k = lane; k < s.collider_count; k += 32) {
    double sums[kImpulseSums];
    for (int i = 0; i < kImpulseSums; ++i) {
      sums[i] = double(s.impulse_units[kImpulseSums * k + i]) * sum_unit(s, i);
      s.impulse_units[kImpulseSums * k + i] = 0;
    }
    const double moved = end_collider(s, k, sums, s.clock->dt);
    if (moved > 0.0) raise_to(&s.clock->moved, sortable(float(moved) * 1.000001f));
  }
  __threadfence();
  __syncwarp();
  if (lane != 0) return;
  // On a copy: all loads at once, then all stores.
  SolverClock clock = *s.clock;
  clock.travel += float_of_bits(clock.moved);
  clock.moved = 0;
  end_step(clock, double(s.dx), s.count);
  choose_unit(clock);
  *s.clock = clock;
}

// sum w v and sum w v (node - particle) over a stencil, in cells; along z first, then y, then x.
// The weights of an axis sum to one and their first moments to zero, so each sum is taken of
// differences to the middle node: what all nodes share goes through without a rounding, and bodies
// that fly or spin freely keep their momentum longer.
template <typename T>
__device__ __forceinline__ void gather(const Stencil<T>& st, const T (&tile)[3][kTile], int base,
                                       T (&value)[3], Mat3<T>& moment) {
  T lever[3][3];  // w (node - particle) of each axis
#pragma unroll
  for (int axis = 0; axis < 3; ++axis)
#pragma unroll
    for (int k = 0; k < 3; ++k) lever[axis][k] = st.w[axis][k] * (T(k) - st.f[axis]);
#pragma unroll
  for (int c = 0; c < 3; ++c) {
    T plane[3], plane_y[3], plane_z[3];
#pragma unroll
    for (int i = 0; i < 3; ++i) {
      T row[3], row_z[3];
#pragma unroll
      for (int j = 0; j < 3; ++j) {
        const int at = base + i * kStrideX + j * kStrideY;
        const T middle = tile[c][at + 1];
        const T below = tile[c][at] - middle, above = tile[c][at + 2] - middle;
        row[j] = (middle + st.w[2][0] * below) + st.w[2][2] * above;
        row_z[j] = lever[2][0] * below + lever[2][2] * above;
      }
      const T below = row[0] - row[1], above = row[2] - row[1];
      plane[i] = row[1] + (st.w[1][0] * below + st.w[1][2] * above);
      plane_y[i] = lever[1][0] * below + lever[1][2] * above;
      plane_z[i] = st.w[1][0] * row_z[0] + st.w[1][1] * row_z[1] + st.w[1][2] * row_z[2];
    }
    const T below = plane[0] - plane[1], above = plane[2] - plane[1];
    const T* w = st.w[0];
    value[c] = plane[1] + (w[0] * below + w[2] * above);
    moment(c, 0) = lever[0][0] * below + lever[0][2] * above;
    moment(c, 1) = w[0] * plane_y[0] + w[1] * plane_y[1] + w[2] * plane_y[2];
    moment(c, 2) = w[0] * plane_z[0] + w[1] * plane_z[1] + w[2] * plane_z[2];
  }
}

template <typename T, int kLaws, bool kTrack>
__global__ void __launch_bounds__(kG2PThreads, kG2PCtas)
    g2p_kernel(const __grid_constant__ SolverView<T> s, int split_shift) {
  const SolverClock& clock = *s.clock;
  const int64_t home = blockIdx.x >> split_shift;
  if (!may_step(clock) || home >= clock.homes) return;
  const int part = blockIdx.x & ((1 << split_shift) - 1);
  __shared__ T tile[3][kTile];
  __shared__ CtaEnd<4> end;
  end.clear();
  const HomeList<T>& homes = s.homes();
  const int64_t first = homes.start[home];
  const int64_t count = min(int64_t(homes.count[home]), s.count - first);
  const T dt = T(clock.dt), dt_next = T(clock.dt_next);
  const int64_t arrivals = clock.homes << split_shift;
  const bool waves = measures_waves(clock, kLaws);
  const T slack = T(clock.slack);
  const int32_t* neighbour = s.neighbour + home * kNeighbours;
  const uint32_t reach = reach_of_row(neighbour);
  const int stride = kG2PThreads << split_shift;
  int64_t r = part * kG2PThreads + threadIdx.x;
  bool here = first >= 0 && r < count;
  for (int index = threadIdx.x; index < kWindowNodes; index += kG2PThreads) {
    int i, j, k;
    const int at = window_node(index, i, j, k);
    const int64_t node = slot_node(neighbour, i, j, k);
    const Vec3<T> v = node < 0 ? Vec3<T>{T(0), T(0), T(0)} : load_velocity(s, node);
    for (int c = 0; c < 3; ++c) tile[c][at] = v[c];
  }
  __syncthreads();
  Largest largest{};
  bool leaves = false, lost = false;
  while (__any_sync(kAllLanes, here)) {
    StepFlags flags{};
    if (here) {
      const ParticleBefore<T> before = particle_before<T, kLaws>(s, first + r);
      const uint32_t meta = before.meta;
      prefetch(s.rows + int64_t(before.row) * kRowColumns);
      const Stencil<T> st = stencil_at(before.offset);
      const int base = min(meta_cell(meta, 0), kLastCell) * kStrideX +
                       min(meta_cell(meta, 1), kLastCell) * kStrideY +
                       min(meta_cell(meta, 2), kLastCell);
      T value[3] = {};
      Mat3<T> moment{};
      gather(st, tile, base, value, moment);
      flags = finish_particle<T, kLaws, kTrack>(s, first + r, before, reach, value, moment, dt,
                                                dt_next, waves, slack, largest);
    }
    if constexpr (kLaws != kElasticOnly) count_lanes(flags.plastic, &s.clock->plastic);
    if (__any_sync(kAllLanes, flags.guarded || flags.inverted || flags.invalid)) {
      count_lanes(flags.guarded, &s.clock->guarded);
      count_lanes(flags.inverted, &s.clock->inverted);
      count_lanes(flags.invalid, &s.clock->invalid);
    }
    leaves = leaves || flags.leaves;
    lost = lost || flags.lost;
    r += stride;
    here = here && r < count;
  }
  count_lanes(leaves, &s.clock->leaving);
  count_lanes(lost, &s.clock->lost);
  const float values[4] = {largest.speed2, largest.wave2, largest.gradient2, largest.bound};
  unsigned bits[4];
  if (!end.leave(values, bits)) return;
  hand_over(s, bits, home, true);
  if (last_to_arrive(&s.clock->arrived, arrivals)) end_of_step(s);
}

template <typename T>
__global__ void __launch_bounds__(kThreads)
    prime_kernel(const __grid_constant__ SolverView<T> s, bool measure) {
  const SolverClock& clock = *s.clock;
  if (int64_t(blockIdx.x) >= clock.homes) return;
  __shared__ CtaEnd<4> end;
  end.clear();
  __syncthreads();
  const HomeList<T>& homes = s.homes();
  const int64_t first = homes.start[blockIdx.x], count = homes.count[blockIdx.x];
  const int64_t home_total = clock.homes;
  const T dt = T(clock.dt);
  Largest largest{};
  for (int64_t r = threadIdx.x; r < count; r += kThreads)
    if (first + r >= 0 && first + r < s.count) prime_particle(s, first + r, measure, dt, largest);
  __syncwarp();
  const float values[4] = {largest.speed2, largest.wave2, largest.gradient2, largest.bound};
  unsigned bits[4];
  if (!end.leave(values, bits)) return;
  hand_over(s, bits, measure ? -1 : int64_t(blockIdx.x), measure);
  if (!last_to_arrive(&s.clock->arrived, home_total) || (threadIdx.x & 31) != 0) return;
  if (measure)
    start_clock(*s.clock, double(s.dx));
  else
    choose_unit(*s.clock);
}

}  // namespace

template <typename T>
cudaError_t solver_prime(const SolverView<T>& s, cudaStream_t stream) {
  const unsigned homes = static_cast<unsigned>(s.home_capacity);
  prime_kernel<T><<<homes, kThreads, 0, stream>>>(s, true);
  prime_kernel<T><<<homes, kThreads, 0, stream>>>(s, false);
  return cudaGetLastError();
}

template <typename T>
cudaError_t solver_step(const SolverView<T>& s, int law_set, cudaStream_t stream) {
  const unsigned homes = static_cast<unsigned>(s.home_capacity);
  const int shift = split_shift(s);
  const unsigned ctas = homes << shift;
  constexpr int kSlotsPerCta = kThreads / kBlockNodes;
  const unsigned slots = static_cast<unsigned>((s.slot_capacity + kSlotsPerCta - 1) / kSlotsPerCta);
  p2g_kernel<T><<<ctas, kP2GThreads, 0, stream>>>(s, shift);
  if (s.moments != nullptr) {
    p2g_shared_kernel<T><<<min(ctas, kSharedCtas), kP2GThreads, 0, stream>>>(s, shift);
    contact_kernel<T>  // a shared site has two slots at least
        <<<min(static_cast<unsigned>((s.slot_capacity + 1) / 2), kSharedCtas), kBlockNodes, 0,
           stream>>>(s);
  }
  grid_kernel<T><<<slots, kThreads, 0, stream>>>(s);
  const bool track = s.deformation != nullptr;
  if (law_set == kElasticOnly && !track)
    g2p_kernel<T, kElasticOnly, false><<<ctas, kG2PThreads, 0, stream>>>(s, shift);
  else if (law_set == kElasticOnly)
    g2p_kernel<T, kElasticOnly, true><<<ctas, kG2PThreads, 0, stream>>>(s, shift);
  else if (law_set == kBrittle && !track)
    g2p_kernel<T, kBrittle, false><<<ctas, kG2PThreads, 0, stream>>>(s, shift);
  else if (law_set == kBrittle)
    g2p_kernel<T, kBrittle, true><<<ctas, kG2PThreads, 0, stream>>>(s, shift);
  else if (!track)
    g2p_kernel<T, kAnyLaw, false><<<ctas, kG2PThreads, 0, stream>>>(s, shift);
  else
    g2p_kernel<T, kAnyLaw, true><<<ctas, kG2PThreads, 0, stream>>>(s, shift);
  return cudaGetLastError();
}

#define GSF_INSTANTIATE(T)                                                  \
  template cudaError_t solver_prime<T>(const SolverView<T>&, cudaStream_t); \
  template cudaError_t solver_step<T>(const SolverView<T>&, int, cudaStream_t);
GSF_INSTANTIATE(float)
GSF_INSTANTIATE(double)
#undef GSF_INSTANTIATE

}  // namespace gsf::cuda
