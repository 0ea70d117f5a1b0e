// Nodes to particles with the material laws, and what the last warp of a step does.
#pragma once

#include "core/solver/damage.h"
#include "cuda/solver/p2g.h"

namespace gsf::cuda {
namespace {

constexpr int kG2PThreads = 128;  // as kP2GThreads
// CTAs of a multiprocessor: more for the laws that need fewer registers.
constexpr int g2p_ctas(int laws, bool keeps) {
  if (keeps) return 4;
  if (with_springs(laws)) return 5;
  return laws == kElasticOnly ? 7 : 6;
}

// Brings the line at p near; nothing waits for it.
__device__ inline void prefetch(const void* p) {
  asm volatile("prefetch.global.L1 [%0];" ::"l"(p));
}

// Maxima of a step, for the clock and the home. One warp calls; each lane sees to one of them.
template <typename T>
__device__ void hand_over(const SolverView<T>& s, const unsigned (&bits)[4], int64_t home,
                          bool moving) {
  const int lane = threadIdx.x & 31;
  SolverClock& c = *s.clock;
  if (lane < 3 && moving)
    raise_to(lane == 0 ? &c.speed : (lane == 1 ? &c.wave : &c.gradient),
             root_up(lane == 0 ? bits[0] : (lane == 1 ? bits[1] : bits[2])));
  if (lane == 3 && home >= 0) {
    const float bound = __uint_as_float(bits[3]) * 1.000002f;
    raise_real(s.home_bound + home, T(bound));
    raise_to(&c.bound, __float_as_uint(bound));
  }
  __syncwarp();
}

// What the last warp of a step does, once it knows of all ranks: colliders move on, then time. Out
// of line, so that g2p does not hold its registers.
template <typename T>
__device__ __noinline__ void end_of_step(const SolverView<T>& s) {
  const int lane = threadIdx.x & 31;
  for (int64_t k = lane; k < s.collider_count; k += 32) {
    // All loads before the first store, so that they are under way together.
    int64_t units[kImpulseSums];
    for (int i = 0; i < kImpulseSums; ++i) units[i] = s.impulse_units[kImpulseSums * k + i];
    double sums[kImpulseSums];
    for (int i = 0; i < kImpulseSums; ++i) {
      sums[i] = double(units[i]) * sum_unit(s, i);
      if (units[i] != 0) s.impulse_units[kImpulseSums * k + i] = 0;
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
  end_step(clock, double(s.dx), s.total);
  if (wants_damage(s)) clock.grow = 1;  // the host goes on with rounds that have it
  choose_unit(clock);
  *s.clock = clock;
}

// What it does instead on one of several ranks: tells what the step was like.
template <typename T>
__device__ __noinline__ void tell(const SolverView<T>& s) {
  const int lane = threadIdx.x & 31;
  SolverClock& c = *s.clock;
  for (int64_t i = lane; i < s.collider_count * kImpulseSums; i += 32)
    s.mail[kMailWords + i] = s.impulse_units[i];
  if (lane != 0) return;
  s.mail[kMailSpeed] = static_cast<int64_t>(c.speed);
  s.mail[kMailWave] = static_cast<int64_t>(c.wave);
  s.mail[kMailGradient] = static_cast<int64_t>(c.gradient);
  s.mail[kMailBound] = static_cast<int64_t>(c.bound);
  s.mail[kMailPlastic] = c.plastic;
  s.mail[kMailGuarded] = c.guarded;
  s.mail[kMailInverted] = c.inverted;
  s.mail[kMailInvalid] = c.invalid;
  s.mail[kMailTouched] = c.touched;
  s.mail[kMailLost] = c.lost;
  s.mail[kMailLeaving] = c.leaving;
  c.plastic = c.guarded = c.inverted = c.invalid = 0;
}

// Brings velocities of the nodes of a window near.
template <typename T>
__device__ void load_window(const T* velocity, const int32_t* neighbour, T (&tile)[3][kTile]) {
  for (int index = threadIdx.x; index < kWindowNodes; index += kG2PThreads) {
    int i, j, k;
    const int at = window_node(index, i, j, k);
    const int64_t node = slot_node(neighbour, i, j, k);
    const Vec3<T> v = node < 0 ? Vec3<T>{T(0), T(0), T(0)} : load_velocity(velocity, node);
    for (int c = 0; c < 3; ++c) tile[c][at] = v[c];
  }
}

template <typename T>
__device__ void gather_window(const T (&tile)[3][kTile], int base, const Stencil<T>& st, T* value,
                              Mat3<T>& moment) {
  const auto node = [&](int c, int i, int j, int k) {
    return tile[c][base + i * kStrideX + j * kStrideY + k];
  };
  // Two fused operations; one rounding more does not show beside those of the sums below it.
  const auto row = [](T middle, T w0, T low, T w2, T high) {
    return (middle + w0 * low) + w2 * high;
  };
  gather_stencil(st, node, row, value, moment);
}

// Step of which a mark in SolverView::damage_slots tells; 0 is none.
__device__ inline int32_t damage_stamp(int64_t step) { return static_cast<int32_t>(step + 1); }
// Lists the slot in the middle of a point whose damage is solved for; `neighbour` is its home's.
template <typename T>
__device__ void mark_slot(const SolverView<T>& s, const int32_t* neighbour, uint32_t meta,
                          int32_t stamp) {
  const int32_t slot = neighbour[middle_block(meta)];
  if (slot < 0 || slot >= s.slot_capacity) return;
  int32_t* mark = s.damage_slots + kHotPlane * s.slot_capacity + slot;
  if (*mark == stamp || atomicExch(mark, stamp) == stamp) return;
  const int32_t at = atomicAdd(s.damage_counts + kHotCount, 1);
  s.damage_slots[kHotList * s.slot_capacity + at] = slot;
}

// kKeeps: for points that keep a share of their own motion (cuda/solver/flip.cu).
template <typename T, int kLaws, bool kTrack, bool kKeeps>
__global__ void __launch_bounds__(kG2PThreads, g2p_ctas(kLaws, kKeeps))
    g2p_kernel(const __grid_constant__ SolverView<T> s, int split_shift) {
  const SolverClock& clock = *s.clock;
  const int64_t home = blockIdx.x >> split_shift;
  if (!may_step(clock) || home >= clock.homes) return;
  const int part = blockIdx.x & ((1 << split_shift) - 1);
  __shared__ T tile[3][kTile];
  __shared__ T free_tile[kKeeps ? 3 : 1][kKeeps ? kTile : 1];
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
  load_window(s.node_velocity, neighbour, tile);
  if constexpr (kKeeps) load_window(s.free_velocity, neighbour, free_tile);
  __syncthreads();
  Largest largest{};
  bool leaves = false, lost = false;
  while (__any_sync(kAllLanes, here)) {
    StepFlags flags{};
    if (here) {
      ParticleBefore<T> before = particle_before<T, kLaws, kKeeps>(s, first + r);
      prefetch(s.rows + int64_t(before.row) * kRowColumns);
      const Stencil<T> st = stencil_at(before.offset);
      const int base = window_base(before.meta);
      T value[3] = {};
      Mat3<T> moment{};
      if constexpr (kKeeps) {
        gather_window(free_tile, base, st, value, moment);
        leave_share(s, value, moment, before);
      }
      gather_window(tile, base, st, value, moment);
      flags = finish_particle<T, kLaws, kTrack, kKeeps>(s, first + r, before, reach, value, moment,
                                                        dt, dt_next, waves, slack, largest);
      if constexpr (kLaws == kDamageField)
        if (flags.hot)
          mark_slot(s, neighbour, load_meta(s, first + r), damage_stamp(clock.step + 1));
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
  if (!last_to_arrive(&s.clock->arrived, arrivals)) return;
  if (s.peers == nullptr)
    end_of_step(s);
  else
    tell(s);
}

// A kernel of its own for points without a deformation where it has few laws, in float; elsewhere
// one that looks whether there is a deformation serves both, which saves a fifth of the library.
template <typename T, int kLaws, bool kKeeps>
void launch_g2p(const SolverView<T>& s, cudaStream_t stream) {
  constexpr bool kOwn =
      sizeof(T) == sizeof(float) && !kKeeps && (kLaws <= kBrittle || kLaws == kDamageField);
  const int shift = split_shift(s);
  const unsigned ctas = static_cast<unsigned>(s.home_capacity) << shift;
  if (!kOwn || s.deformation != nullptr)
    g2p_kernel<T, kLaws, true, kKeeps><<<ctas, kG2PThreads, 0, stream>>>(s, shift);
  else if constexpr (kOwn)
    g2p_kernel<T, kLaws, false, kKeeps><<<ctas, kG2PThreads, 0, stream>>>(s, shift);
}

}  // namespace
}  // namespace gsf::cuda
