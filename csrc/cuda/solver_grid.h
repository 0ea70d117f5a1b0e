// Nodes of the resident solver: sums to velocities, contact between fields, colliders.
#pragma once

#include "cuda/solver_reduce.h"

namespace gsf::cuda {
namespace {

constexpr int kContactSites = 4;  // sites of one CTA of contact_kernel

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
__device__ void clear_sums(const SolverView<T>& s, int64_t node) {
  longlong2* words = reinterpret_cast<longlong2*>(static_cast<int64_t*>(s.sums) + 4 * node);
  words[0] = words[1] = longlong2{0, 0};
  if (s.moments == nullptr || s.slot_shared[node / kBlockNodes] == 0) return;
  int64_t* m = static_cast<int64_t*>(s.moments) + kContactMoments * node;
  for (int c = 0; c < kContactMoments; ++c) m[c] = 0;
}

// Colliders that can touch a node of the block, as bits; the lanes of a warp look at one each. A
// sweeping or moving collider reaches as far as anything can move in the step. More than 64
// colliders: the last bit stands for all the others.
template <typename T>
__device__ uint64_t colliders_near(const SolverView<T>& s, const Vec3<T>& middle) {
  if (s.collider_count == 0) return 0;
  const T reach = T(2.7) * s.dx + T(s.clock->dt) * T(s.clock->speed_seen);
  uint64_t near = 0;
  for (int first = 0; first < 64 && first < s.collider_count; first += 32) {
    const int k = first + (threadIdx.x & 31);
    bool touches = false;
    if (k < s.collider_count && k < 63) {
      const T* row = s.colliders + int64_t(k) * kColliderColumns;
      Vec3<T> normal;
      const T own = norm(load_vec3(row + kVelocity)) * T(s.clock->dt);
      touches = collider_valid(row, 0) &&
                collider_signed_distance(row, static_cast<const float*>(nullptr), middle, normal) <=
                    reach + own;
    }
    near |= uint64_t(__ballot_sync(kAllLanes, touches)) << first;
  }
  if (s.collider_count > 63) near |= uint64_t(1) << 63;
  return near;
}

template <typename T>
__device__ void collide_one(const SolverView<T>& s, int64_t k, const Vec3<T>& x, double mass,
                            Vec3<T>& v) {
  double impulse[3] = {0.0, 0.0, 0.0};
  node_collide(s, k, x, mass, v, impulse);
  const double per_unit = 1.0 / s.clock->momentum_unit;
  for (int i = 0; i < 3; ++i) {
    const long long units = __double2ll_rn(impulse[i] * per_unit);
    if (units != 0)
      atomicAdd(reinterpret_cast<unsigned long long*>(s.impulse_units + 3 * k + i),
                static_cast<unsigned long long>(units));
  }
}

template <typename T>
__device__ __noinline__ void collide_near(const SolverView<T>& s, uint64_t near, const Vec3<T>& x,
                                          double mass, Vec3<T>& v) {
  for (; near != 0; near &= near - 1) {
    const int64_t k = __ffsll(static_cast<long long>(near)) - 1;
    const int64_t last = k == 63 ? s.collider_count : k + 1;
    for (int64_t i = k; i < last; ++i) collide_one(s, i, x, mass, v);
  }
}

template <typename T>
__device__ void store_velocity(const SolverView<T>& s, int64_t node, const Vec3<T>& v) {
  T* out = s.node_velocity + 4 * node;
  out[0] = v.x;
  out[1] = v.y;
  out[2] = v.z;
}

template <typename T>
__device__ Vec3<T> node_place(const int32_t* block, T x, T y, T z, T dx) {
  return {(T(block[0]) * T(kBlockEdge) + x) * dx, (T(block[1]) * T(kBlockEdge) + y) * dx,
          (T(block[2]) * T(kBlockEdge) + z) * dx};
}

// What contact reads around one node: sums of all slots that hold moments.
template <typename T>
struct SlotNear {
  const SolverView<T>& s;
  const int32_t (*around)[kNeighbours];  // by field of the site
  int local;
  double mass_unit;

  __device__ ContactSample<T> operator()(int field, int o) const {
    const ContactSample<T> none{T(0), {T(0), T(0), T(0)}};
    int there;
    const int block = near_block(local, o, there);
    const int32_t slot = around[field][block];
    if (slot < 0) return none;
    const int64_t node = int64_t(slot) * kBlockNodes + there;
    const int64_t mass = static_cast<const int64_t*>(s.sums)[4 * node + 3];
    if (mass <= 0) return none;
    const int64_t* m = static_cast<const int64_t*>(s.moments) + kContactMoments * node;
    return {
        T(double(mass) * mass_unit),
        {T(double(m[0]) * mass_unit), T(double(m[1]) * mass_unit), T(double(m[2]) * mass_unit)}};
  }
};

// Velocities of the sites that several fields share. Before grid_kernel, which clears the sums that
// this one reads, its own and those of the nodes around.
template <typename T>
__global__ void __launch_bounds__(kBlockNodes) contact_kernel(SolverView<T> s) {
  const SolverClock& clock = *s.clock;
  if (!may_step(clock) || clock.shared_sites == 0) return;
  __shared__ int32_t around[kSiteFields][kNeighbours];
  const int local = threadIdx.x;
  const T dt = T(clock.dt);
  for (int64_t site = int64_t(blockIdx.x) * kContactSites, end = site + kContactSites;
       site < end && site < clock.sites; ++site) {
    const int32_t* slots = s.site_slots + site * kSiteFields;
    if (slots[0] < 0 || slots[1] < 0) continue;
    int count = 0;
    while (count < kSiteFields && slots[count] >= 0 && slots[count] < s.slot_capacity) ++count;
    __syncthreads();
    for (int i = threadIdx.x; i < count * kNeighbours; i += kBlockNodes) {
      const int32_t* c = s.slot_coord + 4 * int64_t(slots[i / kNeighbours]);
      const int32_t slot = slot_around(s, c, i % kNeighbours);
      around[i / kNeighbours][i % kNeighbours] =
          slot >= 0 && slot < s.slot_capacity && s.slot_shared[slot] != 0 ? slot : -1;
    }
    __syncthreads();
    const int32_t* block = s.slot_coord + 4 * int64_t(slots[0]);
    const Vec3<T> x = node_place(block, T(local / 16), T(local / 4 % 4), T(local % 4), s.dx);
    const uint64_t near = colliders_near(s, node_place(block, T(1.5), T(1.5), T(1.5), s.dx));
    Vec3<T> velocity[kSiteFields];
    bool heavy[kSiteFields];
    int present = 0;
    for (int f = 0; f < count; ++f) {
      const int64_t node = int64_t(slots[f]) * kBlockNodes + local;
      heavy[f] = node_velocity(s, read_sums(s, node), dt, velocity[f]);
      present += heavy[f] ? 1 : 0;
    }
    int touched = 0;
    if (present > 1)
      touched =
          node_contact(s, count, heavy, SlotNear<T>{s, around, local, clock.mass_unit}, velocity);
    for (int f = 0; f < count; ++f) {
      const int64_t node = int64_t(slots[f]) * kBlockNodes + local;
      if (heavy[f] && near != 0) collide_near(s, near, x, read_sums(s, node).mass, velocity[f]);
      store_velocity(s, node, velocity[f]);
    }
    if (touched > 0)
      atomicAdd(reinterpret_cast<unsigned long long*>(&s.clock->touched),
                static_cast<unsigned long long>(touched));
  }
}

template <typename T>
__global__ void __launch_bounds__(kSolverThreads) grid_kernel(SolverView<T> s) {
  const SolverClock& clock = *s.clock;
  if (!may_step(clock)) return;
  const int64_t site =
      int64_t(blockIdx.x) * (kSolverThreads / kBlockNodes) + threadIdx.x / kBlockNodes;
  if (site >= clock.sites) return;
  const int local = threadIdx.x % kBlockNodes;
  const int32_t* slots = s.site_slots + site * kSiteFields;
  const int32_t slot = slots[0];
  if (slot < 0 || slot >= s.slot_capacity) return;
  if (slots[1] >= 0) {  // done by contact_kernel
    for (int f = 0; f < kSiteFields && slots[f] >= 0 && slots[f] < s.slot_capacity; ++f)
      clear_sums(s, int64_t(slots[f]) * kBlockNodes + local);
    return;
  }
  const int32_t* block = s.slot_coord + 4 * int64_t(slot);
  const uint64_t near = colliders_near(s, node_place(block, T(1.5), T(1.5), T(1.5), s.dx));
  const int64_t node = int64_t(slot) * kBlockNodes + local;
  const NodeSums<T> sums = read_sums(s, node);
  clear_sums(s, node);
  Vec3<T> v;
  if (node_velocity(s, sums, T(clock.dt), v) && near != 0)
    collide_near(s, near, node_place(block, T(local / 16), T(local / 4 % 4), T(local % 4), s.dx),
                 sums.mass, v);
  store_velocity(s, node, v);
}

}  // namespace
}  // namespace gsf::cuda
