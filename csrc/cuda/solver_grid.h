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

// Units of the sums over nodes that colliders get: torque is counted per 4096 dx of lever, so that
// it stays in the range of the momentum it comes from.
template <typename T>
__device__ double sum_unit(const SolverView<T>& s, int i) {
  const double unit = s.clock->momentum_unit;
  return i < 3 ? unit : (i < 6 ? unit * double(s.dx) * 4096.0 : s.clock->mass_unit);
}

// Velocity after the colliders in `near`. Out of line: few nodes come here.
template <typename T>
__device__ __noinline__ Vec3<T> collide_near(const SolverView<T>& s, uint64_t near, Vec3<T> x,
                                             double mass, Vec3<T> v, T dt) {
  for (; near != 0; near &= near - 1) {
    const int64_t first = __ffsll(static_cast<long long>(near)) - 1;
    const int64_t end = first == 63 ? s.collider_count : first + 1;  // bit 63: all the others
    for (int64_t k = first; k < end; ++k) {
      double sums[kImpulseSums] = {};
      node_collide(s, k, x, mass, dt, v, sums);
      if (sums[6] == 0.0) continue;  // not touched
      for (int i = 0; i < kImpulseSums; ++i) {
        const long long units = __double2ll_rn(sums[i] / sum_unit(s, i));
        if (units != 0)
          atomicAdd(reinterpret_cast<unsigned long long*>(s.impulse_units + kImpulseSums * k + i),
                    static_cast<unsigned long long>(units));
      }
    }
  }
  return v;
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
__global__ void __launch_bounds__(kBlockNodes)
    contact_kernel(const __grid_constant__ SolverView<T> s) {
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
    const uint64_t near = s.collider_count > 0 ? s.site_near[site] : 0;
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
      if (heavy[f] && near != 0)
        velocity[f] = collide_near(s, near, x, read_sums(s, node).mass, velocity[f], dt);
      store_velocity(s, node, velocity[f]);
    }
    if (touched > 0)
      atomicAdd(reinterpret_cast<unsigned long long*>(&s.clock->touched),
                static_cast<unsigned long long>(touched));
  }
}

template <typename T>
__global__ void __launch_bounds__(kSolverThreads, 6)
    grid_kernel(const __grid_constant__ SolverView<T> s) {
  const SolverClock& clock = *s.clock;
  if (!may_step(clock)) return;
  const int64_t site =
      int64_t(blockIdx.x) * (kSolverThreads / kBlockNodes) + threadIdx.x / kBlockNodes;
  // p2g has read the bounds of this step; g2p raises those of the next one from nothing.
  for (int64_t h = int64_t(blockIdx.x) * kSolverThreads + threadIdx.x; h < clock.homes;
       h += int64_t(gridDim.x) * kSolverThreads)
    s.home_bound[h] = T(0);
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
  const uint64_t near = s.collider_count > 0 ? s.site_near[site] : 0;
  const int64_t node = int64_t(slot) * kBlockNodes + local;
  const NodeSums<T> sums = read_sums(s, node);
  clear_sums(s, node);
  Vec3<T> v;
  const T dt = T(clock.dt);
  if (node_velocity(s, sums, dt, v) && near != 0)
    v = collide_near(s, near,
                     node_place(block, T(local / 16), T(local / 4 % 4), T(local % 4), s.dx),
                     sums.mass, v, dt);
  store_velocity(s, node, v);
}

}  // namespace
}  // namespace gsf::cuda
