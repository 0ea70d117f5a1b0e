// One step of the resident solver on the GPU. p2g and g2p: one CTA per home, its window of 8^3
// nodes in shared memory. Sums are integers: in the window 32 bits (float state) in a unit of the
// home, between windows 64 bits in a unit of the step, so that no order of additions changes a bit.
// The units leave room for every particle at one node (csrc/core/solver_clock.h), so nothing
// overflows.
#include "cuda/solver_grid.h"

namespace gsf::cuda {
namespace {

constexpr int kThreads = kSolverThreads;
#ifndef GSF_P2G_THREADS
#define GSF_P2G_THREADS 256
#define GSF_G2P_THREADS 256
#define GSF_G2P_CTAS 3
#endif
constexpr int kP2GThreads = GSF_P2G_THREADS;
constexpr int kG2PThreads = GSF_G2P_THREADS;
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
  static constexpr int kBits = 61;
  static __device__ Word round(double v) { return __double2ll_rn(v); }
  static __device__ void add(Word* p, Word v) {
    atomicAdd(reinterpret_cast<unsigned long long*>(p), static_cast<unsigned long long>(v));
  }
};

// Unit of a window: `count` contributions of at most `bound` fit into 2^kBits of it. The double
// window uses the unit of the step itself.
template <typename T>
__device__ double window_unit(double bound, double share, int64_t count, double step_unit) {
  if (sizeof(T) == 8) return step_unit;
  return ldexp(power_above(fmax(bound, 1e-25) * share * double(count)), -Fixed<T>::kBits);
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

// Small scenes give a home to several CTAs, so that each does less in a row.
constexpr int kMaxSplit = 2;
template <typename T>
int split_of(const SolverView<T>& s) {
  return s.count < 600000 ? kMaxSplit : 1;
}

template <typename T, bool kMoments>
__global__ void __launch_bounds__(kP2GThreads)
    p2g_kernel(const __grid_constant__ SolverView<T> s, int split) {
  using Word = typename Fixed<T>::Word;
  constexpr int kChannels = kMoments ? 4 + kContactMoments : 4;
  const SolverClock& clock = *s.clock;
  if (!may_step(clock) || int64_t(blockIdx.x / split) >= clock.homes) return;
  const int64_t home = blockIdx.x / split;
  const int part = blockIdx.x % split;
  __shared__ Word tile[kChannels][kTile];
  __shared__ int32_t neighbour[kNeighbours];
  __shared__ bool slot_shared[kMoments ? kNeighbours : 1];
  __shared__ int shared_home;
  const HomeList<T>& homes = s.homes();
  const int64_t first = homes.start[home], count = homes.count[home];
  if (threadIdx.x == 0) shared_home = 0;
  for (int i = threadIdx.x; i < kChannels * kTile; i += kP2GThreads) (&tile[0][0])[i] = 0;
  __syncthreads();
  if (threadIdx.x < kNeighbours) {
    const int32_t slot = s.neighbour[home * kNeighbours + threadIdx.x];
    neighbour[threadIdx.x] = slot < s.slot_capacity ? slot : -1;
    if constexpr (kMoments) {
      slot_shared[threadIdx.x] = neighbour[threadIdx.x] >= 0 && s.slot_shared[slot] != 0;
      if (slot_shared[threadIdx.x]) shared_home = 1;
    }
  }
  __syncthreads();
  const bool with_moments = kMoments && shared_home != 0;
  const double unit = window_unit<T>(s.home_bound[home], 0.43, count, clock.momentum_unit);
  const double mass_unit = window_unit<T>(s.home_mass[home], 1.0, count, clock.mass_unit);
  const T per_unit = T(1.0 / unit), per_mass = T(1.0 / mass_unit);
  for (int64_t r = part * kP2GThreads + threadIdx.x; r < count; r += split * kP2GThreads) {
    const int64_t p = first + r;
    if (p < 0 || p >= s.count) continue;
    const uint32_t meta = s.meta[p];
    const uint32_t row = meta_row(meta) < uint64_t(s.row_count) ? meta_row(meta) : 0;
    const T mass = s.rows[int64_t(row) * kRowColumns + kMassColumn];
    T offset[3], velocity[3], slope[9];
    load_three(s, s.offset, p, offset);
    load_three(s, s.velocity, p, velocity);
    load_nine(s, s.slope, p, slope);
    const Stencil<T> st = stencil_at(offset);
    ParticleMomentum<T> q = momentum_given(st, velocity, slope, mass, s.dx);
    for (int i = 0; i < 3; ++i) q.constant[i] *= per_unit;
    for (int i = 0; i < 9; ++i) q.slope.m[i] *= per_unit;
    const T weight_unit = mass * per_mass;
    // Cells are at most kLastCell by construction; garbage cells stay inside the window too.
    const int base = min(meta_cell(meta, 0), kLastCell) * kStrideX +
                     min(meta_cell(meta, 1), kLastCell) * kStrideY +
                     min(meta_cell(meta, 2), kLastCell);
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
            if (with_moments) {
              const Vec3<T> g = contact_moment(st, w * weight_unit, i, j, k);
              for (int c = 0; c < kContactMoments; ++c)
                Fixed<T>::add(&tile[4 + c][at], Fixed<T>::round(g[c]));
            }
          }
        }
  }
  __syncthreads();
  const double to_step = unit / clock.momentum_unit, to_mass = mass_unit / clock.mass_unit;
  int64_t* sums = static_cast<int64_t*>(s.sums);
  int64_t* moments = static_cast<int64_t*>(s.moments);
  for (int index = threadIdx.x; index < kWindowNodes; index += kP2GThreads) {
    int i, j, k;
    const int at = window_node(index, i, j, k);
    // All four: the mass of a part of the home may round to nothing where its momentum does not.
    if ((tile[0][at] | tile[1][at] | tile[2][at] | tile[3][at]) == 0) continue;
    const int64_t node = slot_node(neighbour, i, j, k);
    if (node < 0) continue;
    for (int c = 0; c < 4; ++c) {
      const Word word = tile[c][at];
      const long long v =
          sizeof(T) == 8 ? word : __double2ll_rn(double(word) * (c < 3 ? to_step : to_mass));
      if (v != 0)
        atomicAdd(reinterpret_cast<unsigned long long*>(sums + 4 * node + c),
                  static_cast<unsigned long long>(v));
    }
    if constexpr (kMoments) {
      // Only shared slots: nobody would clear the moments of the others.
      if (with_moments && slot_shared[neighbour_of(i, j, k)])
        for (int c = 0; c < kContactMoments; ++c) {
          const Word word = tile[4 + c][at];
          const long long v = sizeof(T) == 8 ? word : __double2ll_rn(double(word) * to_mass);
          if (v != 0)
            atomicAdd(reinterpret_cast<unsigned long long*>(moments + kContactMoments * node + c),
                      static_cast<unsigned long long>(v));
        }
    }
  }
}

template <int kThreadsHere, typename T>
__device__ void hand_over(const SolverView<T>& s, const Largest& largest, int64_t home,
                          bool moving) {
  const float values[4] = {largest.speed2, largest.wave2, largest.gradient2, largest.bound};
  unsigned bits[4];
  block_largest<kThreadsHere>(values, bits);
  if (threadIdx.x != 0) return;
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

// What the last CTA of a step does: colliders move on, then time. Out of line, so that g2p does not
// hold its registers.
template <int kThreadsHere, typename T>
__device__ __noinline__ void end_of_step(const SolverView<T>& s) {
  for (int64_t k = threadIdx.x; k < s.collider_count; k += kThreadsHere) {
    double sums[kImpulseSums];
    for (int i = 0; i < kImpulseSums; ++i) {
      sums[i] = double(s.impulse_units[kImpulseSums * k + i]) * sum_unit(s, i);
      s.impulse_units[kImpulseSums * k + i] = 0;
    }
    const double moved = end_collider(s, k, sums, s.clock->dt);
    if (moved > 0.0) raise_to(&s.clock->moved, sortable(float(moved) * 1.000001f));
  }
  __syncthreads();
  if (threadIdx.x != 0) return;
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
__global__ void __launch_bounds__(kG2PThreads, GSF_G2P_CTAS)
    g2p_kernel(const __grid_constant__ SolverView<T> s, int split) {
  const SolverClock& clock = *s.clock;
  if (!may_step(clock) || int64_t(blockIdx.x / split) >= clock.homes) return;
  const int64_t home = blockIdx.x / split;
  const int part = blockIdx.x % split;
  __shared__ T tile[3][kTile];
  const HomeList<T>& homes = s.homes();
  const int64_t first = homes.start[home], count = homes.count[home];
  const T dt = T(clock.dt), dt_next = T(clock.dt_next);
  const int64_t arrivals = clock.homes * split;
  const bool waves = measures_waves(clock);
  const T slack = T(clock.slack);
  const uint32_t reach = reach_of_row(s.neighbour + home * kNeighbours);
  for (int index = threadIdx.x; index < kWindowNodes; index += kG2PThreads) {
    int i, j, k;
    const int at = window_node(index, i, j, k);
    const int64_t node = slot_node(s.neighbour + home * kNeighbours, i, j, k);
    const Vec3<T> v = node < 0 ? Vec3<T>{T(0), T(0), T(0)} : load_velocity(s, node);
    for (int c = 0; c < 3; ++c) tile[c][at] = v[c];
  }
  __syncthreads();
  Largest largest{};
  bool leaves = false, lost = false;
  const int64_t stride = int64_t(split) * kG2PThreads, rounds = (count + stride - 1) / stride;
  for (int64_t round = 0; round < rounds; ++round) {
    const int64_t r = round * stride + part * kG2PThreads + threadIdx.x, p = first + r;
    StepFlags flags{};
    if (r < count && p >= 0 && p < s.count) {
      const ParticleBefore<T> before = particle_before<T, kLaws>(s, p);
      const uint32_t meta = before.meta;
      const Stencil<T> st = stencil_at(before.offset);
      const int base = min(meta_cell(meta, 0), kLastCell) * kStrideX +
                       min(meta_cell(meta, 1), kLastCell) * kStrideY +
                       min(meta_cell(meta, 2), kLastCell);
      T value[3] = {};
      Mat3<T> moment{};
      gather(st, tile, base, value, moment);
      flags = finish_particle<T, kLaws, kTrack>(s, p, before, reach, value, moment, dt, dt_next,
                                                waves, slack, largest);
    }
    if constexpr (kLaws != kElasticOnly) count_lanes(flags.plastic, &s.clock->plastic);
    if (__any_sync(kAllLanes, flags.guarded || flags.inverted || flags.invalid)) {
      count_lanes(flags.guarded, &s.clock->guarded);
      count_lanes(flags.inverted, &s.clock->inverted);
      count_lanes(flags.invalid, &s.clock->invalid);
    }
    leaves = leaves || flags.leaves;
    lost = lost || flags.lost;
  }
  count_lanes(leaves, &s.clock->leaving);
  count_lanes(lost, &s.clock->lost);
  hand_over<kG2PThreads>(s, largest, home, true);
  if (!last_to_arrive(&s.clock->arrived, arrivals)) return;
  end_of_step<kG2PThreads>(s);
}

template <typename T>
__global__ void __launch_bounds__(kThreads)
    prime_kernel(const __grid_constant__ SolverView<T> s, bool measure) {
  const SolverClock& clock = *s.clock;
  if (int64_t(blockIdx.x) >= clock.homes) return;
  const HomeList<T>& homes = s.homes();
  const int64_t first = homes.start[blockIdx.x], count = homes.count[blockIdx.x];
  const int64_t home_total = clock.homes;
  const T dt = T(clock.dt);
  Largest largest{};
  for (int64_t r = threadIdx.x; r < count; r += kThreads)
    if (first + r >= 0 && first + r < s.count) prime_particle(s, first + r, measure, dt, largest);
  hand_over<kThreads>(s, largest, measure ? -1 : int64_t(blockIdx.x), measure);
  if (!last_to_arrive(&s.clock->arrived, home_total) || threadIdx.x != 0) return;
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
  const int split = split_of(s);
  constexpr int kSitesPerCta = kThreads / kBlockNodes;
  const unsigned sites = static_cast<unsigned>((s.slot_capacity + kSitesPerCta - 1) / kSitesPerCta);
  if (s.moments != nullptr)
    p2g_kernel<T, true><<<homes * split, kP2GThreads, 0, stream>>>(s, split);
  else
    p2g_kernel<T, false><<<homes * split, kP2GThreads, 0, stream>>>(s, split);
  if (s.moments != nullptr)
    contact_kernel<T>  // a shared site has two slots at least
        <<<static_cast<unsigned>((s.slot_capacity + 1) / 2), kBlockNodes, 0, stream>>>(s);
  grid_kernel<T><<<sites, kThreads, 0, stream>>>(s);
  const bool track = s.deformation != nullptr;
  if (law_set == kElasticOnly && !track)
    g2p_kernel<T, kElasticOnly, false><<<homes * split, kG2PThreads, 0, stream>>>(s, split);
  else if (law_set == kElasticOnly)
    g2p_kernel<T, kElasticOnly, true><<<homes * split, kG2PThreads, 0, stream>>>(s, split);
  else if (law_set == kBrittle && !track)
    g2p_kernel<T, kBrittle, false><<<homes * split, kG2PThreads, 0, stream>>>(s, split);
  else if (law_set == kBrittle)
    g2p_kernel<T, kBrittle, true><<<homes * split, kG2PThreads, 0, stream>>>(s, split);
  else if (!track)
    g2p_kernel<T, kAnyLaw, false><<<homes * split, kG2PThreads, 0, stream>>>(s, split);
  else
    g2p_kernel<T, kAnyLaw, true><<<homes * split, kG2PThreads, 0, stream>>>(s, split);
  return cudaGetLastError();
}

#define GSF_INSTANTIATE(T)                                                  \
  template cudaError_t solver_prime<T>(const SolverView<T>&, cudaStream_t); \
  template cudaError_t solver_step<T>(const SolverView<T>&, int, cudaStream_t);
GSF_INSTANTIATE(float)
GSF_INSTANTIATE(double)
#undef GSF_INSTANTIATE

}  // namespace gsf::cuda
