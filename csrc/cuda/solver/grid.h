// Nodes of the resident solver: sums to velocities, contact between fields, colliders.
#pragma once

#include "core/solver/clock.h"
#include "core/solver/points.h"
#include "cuda/solver/reduce.h"

namespace gsf::cuda {
namespace {

constexpr int kGridCtas = 5;            // of a multiprocessor, for grid_kernel's registers
constexpr unsigned kSharedCtas = 2048;  // of the kernels that only shared blocks need

// The i-th slot that is held here. Slots have the same number on all ranks, which list their own.
template <typename T>
__device__ int64_t held_slot(const SolverView<T>& s, int64_t i) {
  return s.peers == nullptr ? i : s.table_count[i];
}

// Reads the sums of one node.
template <typename T>
__device__ NodeSums<T> read_sums(const SolverView<T>& s, int64_t node) {
  NodeSums<T> out;
  const longlong2* words =
      reinterpret_cast<const longlong2*>(static_cast<const int64_t*>(s.sums) + 4 * node);
  const longlong2 a = words[0], b = words[1];
  const double unit = s.clock->momentum_unit;
  out.momentum[0] = double(a.x) * unit;
  out.momentum[1] = double(a.y) * unit;
  out.momentum[2] = double(b.x) * unit;
  out.mass = double(b.y) * s.clock->mass_unit;
  return out;
}

// Clears them for the next step.
template <typename T>
__device__ void clear_sums(const SolverView<T>& s, int64_t node, int32_t shared) {
  longlong2* words = reinterpret_cast<longlong2*>(static_cast<int64_t*>(s.sums) + 4 * node);
  words[0] = words[1] = longlong2{0, 0};
  if (shared == 0) return;
  int64_t* m = static_cast<int64_t*>(s.moments) + kContactMoments * node;
  for (int c = 0; c < kContactMoments; ++c) m[c] = 0;
}

// Units of the sums over nodes that colliders get. What a collider gives is not bounded by what the
// points have, so the unit of an impulse is fixed: all points, each as heavy as the heaviest, may
// change their speed by 8e6 m/s (the clock stops at 1e6). Torque: levers up to 4096 dx.
template <typename T>
__device__ double sum_unit(const SolverView<T>& s, int i) {
  if (i == 6) return s.clock->mass_unit;
  const double heaviest = s.clock->mass_unit * double(int64_t(1) << (s.clock->unit_bits - 1));
  const double impulse = heaviest * double(s.total) * (8e6 / double(int64_t(1) << 62));
  return i < 3 ? impulse : impulse * double(s.dx) * 4096.0;
}

__device__ inline long long warp_sum(long long v) {
  for (int offset = 16; offset > 0; offset /= 2) v += __shfl_xor_sync(kAllLanes, v, offset);
  return v;
}
__device__ inline void add_units(void* to, long long units) {
  atomicAdd(static_cast<unsigned long long*>(to), static_cast<unsigned long long>(units));
}
// The same in memory that may be another device's.
__device__ inline void add_far(void* to, long long units) {
  atomicAdd_system(static_cast<unsigned long long*>(to), static_cast<unsigned long long>(units));
}

// Sums of the first few colliders over a CTA. All nodes of a scene meet at those few words, so they
// are added up as far as possible before they get there.
constexpr int kHeldColliders = 4;
struct HeldSums {
  unsigned long long units[kHeldColliders * kImpulseSums];
  int done;  // warps that have added all they have

  __device__ void clear() {
    for (int i = threadIdx.x; i < kHeldColliders * kImpulseSums; i += blockDim.x) units[i] = 0;
    if (threadIdx.x == 0) done = 0;
  }
  // Called by whole warps; the last one of the CTA hands over, so that none waits for another.
  template <typename T>
  __device__ void hand_over(const SolverView<T>& s) {
    const int lane = threadIdx.x & 31;
    __threadfence_block();
    int before = lane == 0 ? atomicAdd(&done, 1) : 0;
    before = __shfl_sync(kAllLanes, before, 0);
    if (before + 1 < int(blockDim.x) / 32) return;
    __threadfence_block();
    for (int i = lane; i < kHeldColliders * kImpulseSums; i += 32) {
      const unsigned long long sum = atomicAdd(units + i, 0ull);
      if (sum != 0) add_units(s.impulse_units + i, static_cast<long long>(sum));
    }
  }
};

// Books what the lanes of a warp got from collider k.
template <typename T>
__device__ __forceinline__ void book(const SolverView<T>& s, HeldSums& held, int64_t k,
                                     const double* sums) {
  const double units_of[3] = {1.0 / sum_unit(s, 0), 1.0 / sum_unit(s, 3), 1.0 / sum_unit(s, 6)};
  for (int i = 0; i < kImpulseSums; ++i) {
    const long long units = warp_sum(__double2ll_rn(sums[i] * units_of[i / 3]));
    if (units == 0 || (threadIdx.x & 31) != 0) continue;
    if (k < kHeldColliders)
      add_units(held.units + kImpulseSums * k + i, units);
    else
      add_units(s.impulse_units + kImpulseSums * k + i, units);
  }
}

// Velocity after the colliders in `near`, for all lanes of a warp together (`near` and `answers`
// are the same in all; without the latter nothing is booked). Out of line: few nodes come here.
template <typename T, bool kPoints>
__device__ __noinline__ Vec3<T> collide_near(const SolverView<T>& s, HeldSums& held, uint64_t near,
                                             bool answers, bool active, Vec3<T> x, double mass,
                                             int32_t cut, Vec3<T> v, T dt) {
  for (; near != 0; near &= near - 1) {
    const int64_t first = __ffsll(static_cast<long long>(near)) - 1;
    const int64_t end = first == 63 ? s.collider_count : first + 1;  // bit 63: all the others
    for (int64_t k = first; k < end; ++k) {
      double sums[kImpulseSums] = {};
      if (active && (!kPoints || holds_node(s, k, x)))
        node_collide(s, k, x, mass, cut, dt, v, sums);
      if (!answers || !__any_sync(kAllLanes, sums[6] != 0.0)) continue;  // none touches
      book(s, held, k, sums);
    }
  }
  return v;
}

// Velocities are stored in fours, so that a node is read and written at once.
__device__ inline void store_velocity(float* velocity, int64_t node, const Vec3<float>& v) {
  reinterpret_cast<float4*>(velocity)[node] = {v.x, v.y, v.z, 0.0f};
}
__device__ inline void store_velocity(double* velocity, int64_t node, const Vec3<double>& v) {
  double2* out = reinterpret_cast<double2*>(velocity) + 2 * node;
  out[0] = {v.x, v.y};
  out[1] = {v.z, 0.0};
}
__device__ inline Vec3<float> load_velocity(const float* velocity, int64_t node) {
  const float4 v = reinterpret_cast<const float4*>(velocity)[node];
  return {v.x, v.y, v.z};
}
__device__ inline Vec3<double> load_velocity(const double* velocity, int64_t node) {
  const double2* v = reinterpret_cast<const double2*>(velocity) + 2 * node;
  const double2 low = v[0], high = v[1];
  return {low.x, low.y, high.x};
}

template <typename T>
__device__ Vec3<T> node_place(const int32_t* block, T x, T y, T z, T dx) {
  return {(T(block[0]) * T(kBlockEdge) + x) * dx, (T(block[1]) * T(kBlockEdge) + y) * dx,
          (T(block[2]) * T(kBlockEdge) + z) * dx};
}

// What colliders (`push`) or points of other objects (`press`) give to the points about a node:
// fixed-point sums. Their unit is that of clock.h for momentum, of the largest number that a point
// of this step is given; its bits stand behind the rows of `spring_rows`.
enum Given : int { kPush, kPress };
template <typename T>
__device__ uint64_t* given_bound(const SolverView<T>& s, int which) {
  return reinterpret_cast<uint64_t*>(s.spring_rows + 2 * (s.row_count + 1)) + which;
}
template <typename T>
__device__ double given_unit(const SolverView<T>& s, int which) {
  const double bound = float_of_bits(*given_bound(s, which));
  return ldexp(power_above(fmax(bound, 1e-30)), -int(s.clock->unit_bits));
}
__device__ inline double read_given(const int64_t* sums, double unit, int64_t node, int c) {
  return double(sums[4 * node + c]) * unit;
}
// Bits of SolverView::slot_given.
constexpr int32_t kPushed = 1 << kPush, kPressed = 1 << kPress;

// Sums of a node with what its points are given; `given` is that of its slot.
template <typename T, bool kPoints>
__device__ __forceinline__ NodeSums<T> read_all(const SolverView<T>& s, int64_t node,
                                                int32_t given) {
  NodeSums<T> sums = read_sums(s, node);
  if constexpr (kPoints) {
    for (const int which : {kPush, kPress}) {
      if ((given >> which & 1) == 0) continue;
      const double unit = given_unit(s, which);
      for (int c = 0; c < 3; ++c)
        sums.momentum[c] += read_given(which == kPush ? s.push : s.press, unit, node, c);
    }
  }
  return sums;
}
// Clears the latter for the next step.
template <typename T>
__device__ void clear_given(const SolverView<T>& s, int64_t node, int32_t given) {
  for (const int which : {kPush, kPress}) {
    if ((given >> which & 1) == 0) continue;
    longlong2* words = reinterpret_cast<longlong2*>((which == kPush ? s.push : s.press) + 4 * node);
    words[0] = words[1] = longlong2{0, 0};
  }
}

// Friction where points of different objects push each other. Out of line, as collide_near.
template <typename T, typename Number, typename Mass, typename Node>
__device__ __noinline__ void hold_near(const SolverView<T>& s, int fields, const bool* heavy,
                                       const Number& number, const Mass& mass, const Node& node,
                                       Vec3<T>* velocity) {
  bool any = false;
  for (int f = 0; f < fields; ++f)
    for (int c = 0; c < 3; ++c) any = any || s.press[4 * node(f) + c] != 0;
  if (!any) return;
  const double unit = given_unit(s, kPress);
  const auto press = [&](int f, int c) { return T(read_given(s.press, unit, node(f), c)); };
  node_hold(s, fields, heavy, number, mass, press, velocity);
}

// Friction where colliders push points, for all lanes of a warp together: node(f) is that of the
// f-th field. Out of line likewise.
template <typename T, typename Number, typename Mass, typename Node>
__device__ __noinline__ void rub_near(const SolverView<T>& s, HeldSums& held, bool answers,
                                      int fields, const bool* heavy, const Number& number,
                                      const Mass& mass, const Node& node, const Vec3<T>& x,
                                      Vec3<T>* velocity) {
  double sums[kImpulseSums] = {};
  int64_t k = -1;
  const double unit = given_unit(s, kPush);
  const auto push = [&](int f, int c) { return T(read_given(s.push, unit, node(f), c)); };
  const auto which = [&](int64_t i) { return pushes_points(s, i) ? i : int64_t(-1); };
  const auto nearest = [&] { return nearest_collider(s, s.collider_count, which, x); };
  const auto account = [&](int64_t one) {
    k = one;
    return sums;
  };
  node_rub(s, fields, heavy, number, mass, push, x, nearest, account, velocity);
  for (unsigned left = __ballot_sync(kAllLanes, answers && k >= 0); left != 0;) {
    const int64_t one = __shfl_sync(kAllLanes, static_cast<long long>(k), __ffs(left) - 1);
    double own[kImpulseSums];
    for (int i = 0; i < kImpulseSums; ++i) own[i] = k == one ? sums[i] : 0.0;
    book(s, held, one, own);
    left &= ~__ballot_sync(kAllLanes, k == one);
  }
}

// What contact reads around the nodes of a block: sums of all slots that hold moments. Those of the
// first fields of the site lie in shared memory, 6^3 nodes each.
constexpr int kHaloNodes = 216;
constexpr int kStagedFields = 3;

template <typename T>
struct SlotNear {
  const SolverView<T>& s;
  const int32_t (*around)[kNeighbours];  // by field of the site
  const ContactSample<T> (*staged)[kHaloNodes];
  int local;
  double mass_unit;

  __device__ ContactSample<T> operator()(int field, int o) const {
    if (field < kStagedFields) {
      const int i = local / 16 + o / 9, j = local / 4 % 4 + o / 3 % 3, k = local % 4 + o % 3;
      return staged[field][(i * 6 + j) * 6 + k];
    }
    int there;
    const int block = near_block(local, o, there);
    return read(around[field][block], there);
  }

  // Sample of node `there` of a slot.
  __device__ ContactSample<T> read(int32_t slot, int there) const {
    const ContactSample<T> none{T(0), {T(0), T(0), T(0)}};
    if (slot < 0) return none;
    const int64_t node = int64_t(slot) * kBlockNodes + there;
    const int64_t mass = static_cast<const int64_t*>(s.sums)[4 * node + 3];
    const int64_t* m = static_cast<const int64_t*>(s.moments) + kContactMoments * node;
    const int64_t x = m[0], y = m[1], z = m[2];
    if (mass <= 0) return none;
    return {T(double(mass) * mass_unit),
            {T(double(x) * mass_unit), T(double(y) * mass_unit), T(double(z) * mass_unit)}};
  }
};

// Velocities of the sites that several fields share; `table_mask` lists them. Before grid_kernel,
// which clears the sums that this one reads, its own and those of the nodes around.
template <typename T, bool kPoints>
__device__ __forceinline__ void contact_site(const SolverView<T>& s, int64_t site, HeldSums& held) {
  const SolverClock& clock = *s.clock;
  __shared__ int32_t around[kSiteFields][kNeighbours];
  __shared__ ContactSample<T> staged[kStagedFields][kHaloNodes];
  const int local = threadIdx.x;
  const T dt = T(clock.dt);
  const int32_t* slots = s.site_slots + site * kSiteFields;
  int count = 0;
  while (count < kSiteFields && slots[count] >= 0 && slots[count] < s.slot_capacity) ++count;
  for (int i = threadIdx.x; i < count * kNeighbours; i += kBlockNodes) {
    const int32_t* c = s.slot_coord + 4 * int64_t(slots[i / kNeighbours]);
    const int32_t slot = slot_around(s, c, i % kNeighbours);
    around[i / kNeighbours][i % kNeighbours] =
        slot >= 0 && slot < s.slot_capacity && s.slot_shared[slot] != 0 ? slot : -1;
  }
  __syncthreads();
  const SlotNear<T> near_nodes{s, around, staged, local, clock.mass_unit};
  for (int i = threadIdx.x; i < min(count, kStagedFields) * kHaloNodes; i += kBlockNodes) {
    const int field = i / kHaloNodes, node = i % kHaloNodes;
    const int at[3] = {node / 36 - 1, node / 6 % 6 - 1, node % 6 - 1};
    const int block = (block_of(at[0]) * 3 + block_of(at[1])) * 3 + block_of(at[2]) + 13;
    staged[field][node] = near_nodes.read(
        around[field][block], local_index(local_of(at[0]), local_of(at[1]), local_of(at[2])));
  }
  __syncthreads();
  const int32_t* block = s.slot_coord + 4 * int64_t(slots[0]);
  const Vec3<T> x = node_place(block, T(local / 16), T(local / 4 % 4), T(local % 4), s.dx);
  const uint64_t near = s.collider_count > 0 ? s.slot_near[slots[0]] : 0;
  const bool answers = s.answers(slots[0]);
  Vec3<T> velocity[kSiteFields];
  bool heavy[kSiteFields];
  int present = 0;
  [[maybe_unused]] int32_t given_any = 0;
  for (int f = 0; f < count; ++f) {
    const int64_t node = int64_t(slots[f]) * kBlockNodes + local;
    int32_t given = 0;
    if constexpr (kPoints) given = s.slot_given[slots[f]];
    given_any |= given;
    heavy[f] = node_velocity(s, read_all<T, kPoints>(s, node, given), dt, velocity[f]);
    present += heavy[f] ? 1 : 0;
  }
  int touched = 0;
  const auto number = [&](int f) { return s.slot_coord[4 * int64_t(slots[f]) + 3]; };
  const auto node_of = [&](int f) { return int64_t(slots[f]) * kBlockNodes + local; };
  const auto mass = [&](int f) { return read_sums(s, node_of(f)).mass; };
  if (present > 1) touched = node_contact(s, count, heavy, number, mass, near_nodes, velocity);
  if constexpr (kPoints)
    if (present > 1 && (given_any & kPressed) != 0)
      hold_near(s, count, heavy, number, mass, node_of, velocity);
  for (int f = 0; f < count; ++f) {
    const int64_t node = int64_t(slots[f]) * kBlockNodes + local;
    if (near != 0)
      velocity[f] =
          collide_near<T, kPoints>(s, held, near, answers, heavy[f], x, read_sums(s, node).mass,
                                   node_cut(s, count, heavy, number, f), velocity[f], dt);
    if constexpr (!kPoints) store_velocity(s.node_velocity, node, velocity[f]);
  }
  if constexpr (kPoints) {
    if ((given_any & kPushed) != 0)
      rub_near(s, held, answers, count, heavy, number, mass, node_of, x, velocity);
    for (int f = 0; f < count; ++f) store_velocity(s.node_velocity, node_of(f), velocity[f]);
  }
  if (touched > 0 && answers) add_units(&s.clock->touched, 1);  // nodes, not pairs
}

template <typename T, bool kPoints>
__global__ void __launch_bounds__(kBlockNodes)
    contact_kernel(const __grid_constant__ SolverView<T> s) {
  const SolverClock& clock = *s.clock;
  if (!may_step(clock) || int64_t(blockIdx.x) >= clock.shared_sites) return;
  __shared__ HeldSums held;
  held.clear();
  __syncthreads();
  for (int64_t i = blockIdx.x; i < clock.shared_sites; i += gridDim.x) {
    contact_site<T, kPoints>(s, s.table_mask[i], held);
    __syncthreads();  // what lies in shared memory is used again
  }
  held.hand_over(s);
}

// Velocities of the nodes of one slot, where its field is alone; those of shared sites are done by
// contact_kernel, only their sums are cleared.
template <typename T, bool kPoints>
__device__ void update_slot(const SolverView<T>& s, HeldSums& held, int64_t slot) {
  const int local = threadIdx.x % kBlockNodes;
  const int64_t node = slot * kBlockNodes + local;
  const int32_t shared = s.moments != nullptr ? s.slot_shared[slot] : 0;
  const uint64_t near = s.collider_count > 0 ? s.slot_near[slot] : 0;
  int32_t given = 0;
  if constexpr (kPoints) given = s.slot_given[slot];
  const NodeSums<T> sums = read_all<T, kPoints>(s, node, given);
  clear_sums(s, node, shared);
  if (shared == 1 || !s.needs(slot)) {
    if constexpr (kPoints) clear_given(s, node, given);
    return;
  }
  Vec3<T> v;
  const T dt = T(s.clock->dt);
  const bool heavy = node_velocity(s, sums, dt, v);
  if (near != 0) {
    const Vec3<T> x =
        node_place(s.slot_coord + 4 * slot, T(local / 16), T(local / 4 % 4), T(local % 4), s.dx);
    const int32_t cut = s.cut_of(s.slot_coord[4 * slot + 3]);
    v = collide_near<T, kPoints>(s, held, near, s.answers(slot), heavy, x, sums.mass, cut, v, dt);
  }
  if constexpr (kPoints) {
    if ((given & kPushed) != 0) {
      const Vec3<T> x =
          node_place(s.slot_coord + 4 * slot, T(local / 16), T(local / 4 % 4), T(local % 4), s.dx);
      const auto number = [&](int) { return s.slot_coord[4 * slot + 3]; };
      const auto mass = [&](int) { return sums.mass; };
      rub_near(s, held, s.answers(slot), 1, &heavy, number, mass, [&](int) { return node; }, x, &v);
    }
    clear_given(s, node, given);
  }
  store_velocity(s.node_velocity, node, v);
}

template <typename T, bool kPoints>
__global__ void __launch_bounds__(kSolverThreads, kGridCtas)
    grid_kernel(const __grid_constant__ SolverView<T> s) {
  const SolverClock& clock = *s.clock;
  if (!may_step(clock)) return;
  __shared__ HeldSums held;
  if (s.collider_count > 0) {
    held.clear();
    __syncthreads();
  }
  // p2g has read the bounds of this step; g2p raises those of the next one from nothing.
  const int64_t home = int64_t(blockIdx.x) * kSolverThreads + threadIdx.x;
  if (home < clock.homes) s.home_bound[home] = T(0);
  constexpr int kSlotsPerCta = kSolverThreads / kBlockNodes;
  for (int64_t i = int64_t(blockIdx.x) * kSlotsPerCta + threadIdx.x / kBlockNodes; i < clock.slots;
       i += int64_t(gridDim.x) * kSlotsPerCta)
    update_slot<T, kPoints>(s, held, held_slot(s, i));
  if (s.collider_count > 0) held.hand_over(s);
}

// CTAs for `per` of the slots that are held each: for all there is room for; of several ranks for
// about as many as one holds, and each goes on while there are more. CTAs without work take time.
template <typename T>
unsigned slot_ctas(const SolverView<T>& s, int per) {
  const int64_t all = (s.slot_capacity + per - 1) / per;
  if (s.peers == nullptr) return static_cast<unsigned>(all);
  const int64_t homes = (s.home_capacity + kSolverThreads - 1) / kSolverThreads;
  return static_cast<unsigned>(max(homes, all / s.ranks + all / 16 + 1));
}

// kPoints: of scenes whose points are pushed.
template <typename T, bool kPoints>
void launch_nodes(const SolverView<T>& s, cudaStream_t stream) {
  constexpr int kSlotsPerCta = kSolverThreads / kBlockNodes;
  if (s.moments != nullptr)
    contact_kernel<T, kPoints>  // a shared site has two slots at least
        <<<min(static_cast<unsigned>((s.slot_capacity + 1) / 2), kSharedCtas), kBlockNodes, 0,
           stream>>>(s);
  grid_kernel<T, kPoints><<<slot_ctas(s, kSlotsPerCta), kSolverThreads, 0, stream>>>(s);
}

}  // namespace
}  // namespace gsf::cuda
