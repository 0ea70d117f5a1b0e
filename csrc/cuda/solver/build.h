// Blocks of the resident solver on the GPU: a hash table finds homes and slots, particles are
// re-sorted by home, inside a home so that the lanes of a warp lie in different cells. The order of
// homes, slots and particles varies from run to run; no sum depends on it.
#pragma once

#include "cuda/solver/reduce.h"

namespace gsf::cuda {
namespace {

constexpr int kThreads = kSolverThreads;
constexpr int kRanks = 64;  // ranks inside a cell that the stripe order knows

// Entry of a key, inserted when absent; -1 when the table is full. kFar: from several devices.
template <bool kFar = false, typename T>
__device__ int32_t insert(const SolverView<T>& s, uint64_t key) {
  const uint64_t mask = uint64_t(s.table_size) - 1;
  uint64_t at = hash_key(key) & mask;
  for (int64_t tries = 0; tries < s.table_size; ++tries, at = (at + 1) & mask) {
    unsigned long long* entry = reinterpret_cast<unsigned long long*>(s.key + at);
    const unsigned long long before =
        kFar ? atomicCAS_system(entry, kNoKey, key) : atomicCAS(entry, kNoKey, key);
    if (before == kNoKey || before == key) return static_cast<int32_t>(at);
  }
  return -1;
}
__device__ unsigned long long add(int64_t* p, int64_t v) {
  return atomicAdd(reinterpret_cast<unsigned long long*>(p), static_cast<unsigned long long>(v));
}

template <typename T>
__global__ void clear_kernel(const __grid_constant__ SolverView<T> s) {
  if (!may_build(*s.clock)) return;
  const int64_t i = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i < s.table_size) {
    s.key[i] = kNoKey;
    s.table_count[i] = 0;
    s.table_mask[i] = 0;
    s.table_home[i] = -1;
    s.table_slot[i] = -1;
  }
  if (i == 0) {
    s.clock->wanted_homes = s.clock->wanted_slots = 0;
    s.clock->sites = s.clock->cursor = s.clock->shared_sites = s.clock->shared_homes = 0;
  }
}

// Home of every particle: counts, masks, and the particle's rank among those of its home.
template <typename T>
__global__ void __launch_bounds__(kThreads) insert_kernel(const __grid_constant__ SolverView<T> s) {
  const SolverClock& clock = *s.clock;
  if (!may_build(clock) || int64_t(blockIdx.x) >= clock.homes) return;
  const HomeList<T>& homes = s.homes();
  const int32_t* coord = homes.coord + 4 * blockIdx.x;
  const int64_t first = homes.start[blockIdx.x], count = homes.count[blockIdx.x];
  __shared__ int32_t own;
  if (threadIdx.x == 0) own = insert(s, block_key(coord[0], coord[1], coord[2], coord[3]));
  __syncthreads();
  for (int64_t r = threadIdx.x; r < count; r += kThreads) {
    const int64_t p = first + r;
    if (p < 0 || p >= s.count) continue;
    const uint32_t meta = load_meta(s, p);
    int32_t block[3], local[3];
    bool inside = true;
    for (int axis = 0; axis < 3; ++axis) {
      const int32_t cell = 4 * coord[axis] - 1 + meta_cell(meta, axis);
      block[axis] = cell >> 2;
      local[axis] = cell & 3;
      inside = inside && block[axis] > -kBlockRange + 1 && block[axis] < kBlockRange - 2;
    }
    if (!inside) s.clock->reason = kOutside;
    int32_t e = own;
    if (block[0] != coord[0] || block[1] != coord[1] || block[2] != coord[2])
      e = inside ? insert(s, block_key(block[0], block[1], block[2], coord[3])) : own;
    s.entry[p] = e;
    s.place[p] = 0;
    if (e < 0) {
      s.clock->wanted_homes = s.table_size;  // full: certainly too small
      continue;
    }
    s.place[p] = atomicAdd(s.table_count + e, 1);
    const uint32_t mask = reach_of(local[0], local[1], local[2]);
    if ((uint32_t(s.table_mask[e]) & mask) != mask)
      atomicOr(reinterpret_cast<uint32_t*>(s.table_mask + e), mask);
  }
}

// Numbers the homes, gives each its range of particles, and makes entries for all blocks they
// reach. Each entry of the table is looked at by one thread.
template <typename T>
__global__ void __launch_bounds__(kThreads) homes_kernel(const __grid_constant__ SolverView<T> s) {
  if (!may_build(*s.clock)) return;
  const int64_t e = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (e >= s.table_size || s.table_count[e] == 0) return;
  const uint64_t key = s.key[e];
  if (s.table_count[e] > kMostOfHome) s.clock->reason = kFull;
  const int64_t h = static_cast<int64_t>(add(&s.clock->wanted_homes, 1));
  const int64_t start = static_cast<int64_t>(add(&s.clock->cursor, s.table_count[e]));
  if (h < s.home_capacity) {
    const HomeList<T>& homes = s.next_homes();
    for (int axis = 0; axis < 3; ++axis) homes.coord[4 * h + axis] = key_block(key, axis);
    homes.coord[4 * h + 3] = key_field(key);
    homes.start[h] = static_cast<int32_t>(start);
    homes.count[h] = s.table_count[e];
    s.table_home[e] = static_cast<int32_t>(h);
  }
  const uint32_t mask = uint32_t(s.table_mask[e]);
  for (int n = 0; n < kNeighbours; ++n) {
    if (!in_reach(mask, n)) continue;
    const int32_t other =
        insert(s, block_key(key_block(key, 0) + n / 9 - 1, key_block(key, 1) + n / 3 % 3 - 1,
                            key_block(key, 2) + n % 3 - 1, key_field(key)));
    if (other < 0) {
      s.clock->wanted_slots = s.table_size;
      return;
    }
    atomicExch(s.table_slot + other, -2);  // wants a slot
  }
}

// Slots of all reached blocks, chained by site.
template <typename T>
__global__ void __launch_bounds__(kThreads) slots_kernel(const __grid_constant__ SolverView<T> s) {
  if (!may_build(*s.clock)) return;
  const int64_t e = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (e >= s.table_size || s.table_slot[e] != -2) return;
  const uint64_t key = s.key[e];
  if (key_field(key) == kMaxSolverFields) return;
  const int64_t slot = static_cast<int64_t>(add(&s.clock->wanted_slots, 1));
  if (slot >= s.slot_capacity) return;
  s.table_slot[e] = static_cast<int32_t>(slot);
  for (int axis = 0; axis < 3; ++axis) s.slot_coord[4 * slot + axis] = key_block(key, axis);
  s.slot_coord[4 * slot + 3] = key_field(key);
  const int32_t site = insert(s, key | kMaxSolverFields);
  if (site < 0) {
    s.clock->wanted_slots = s.table_size;
    return;
  }
  // The entry of a site holds the head of the chain of its slots.
  s.slot_next[slot] = atomicExch(s.table_slot + site, static_cast<int32_t>(slot));
}

// Nothing has been written yet that a smaller table could not hold: here is where a build gives up.
template <typename T>
__global__ void verdict_kernel(const __grid_constant__ SolverView<T> s) {
  SolverClock& c = *s.clock;
  if (!may_build(c)) return;
  if (c.wanted_homes > s.home_capacity || c.wanted_slots > s.slot_capacity) c.grow = 1;
}

// Slots of each site in ascending field; which slots are shared.
template <typename T>
__global__ void __launch_bounds__(kThreads) sites_kernel(const __grid_constant__ SolverView<T> s) {
  if (!may_build(*s.clock)) return;
  const int64_t e = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (e >= s.table_size || s.key[e] == kNoKey || key_field(s.key[e]) != kMaxSolverFields) return;
  int32_t slots[kSiteFields];
  int count = 0;
  for (int32_t slot = s.table_slot[e]; slot >= 0; slot = s.slot_next[slot]) {
    if (count == kSiteFields) {
      s.clock->reason = kCrowded;
      return;
    }
    int at = count++;
    for (; at > 0 && s.slot_coord[4 * slots[at - 1] + 3] > s.slot_coord[4 * slot + 3]; --at)
      slots[at] = slots[at - 1];
    slots[at] = slot;
  }
  const int64_t site = static_cast<int64_t>(add(&s.clock->sites, 1));
  for (int i = 0; i < kSiteFields; ++i)
    s.site_slots[site * kSiteFields + i] = i < count ? slots[i] : -1;
  for (int i = 0; i < count; ++i) s.slot_shared[slots[i]] = count > 1 ? 1 : 0;
  // The masks have done their work: their words become the list of shared sites.
  if (count > 1) s.table_mask[add(&s.clock->shared_sites, 1)] = static_cast<int32_t>(site);
  uint64_t near = 0;
  const Vec3<T> middle = block_middle(s, s.slot_coord + 4 * int64_t(slots[0]));
  for (int64_t k = 0; k < s.collider_count; ++k)
    if (k >= 63 || collider_near(s, k, middle)) near |= uint64_t(1) << min(k, int64_t(63));
  for (int i = 0; i < count; ++i) s.slot_near[slots[i]] = near;
}

// Contact reads one node beyond the blocks that fields share: marks the slots around those.
template <typename T>
__global__ void __launch_bounds__(kThreads) edges_kernel(const __grid_constant__ SolverView<T> s) {
  if (!may_build(*s.clock) || s.clock->shared_sites == 0) return;
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  const int64_t slot = i / kNeighbours;
  if (slot >= s.clock->wanted_slots || s.slot_shared[slot] != 1) return;
  const int32_t other = slot_around(s, s.slot_coord + 4 * slot, static_cast<int>(i % kNeighbours));
  if (other >= 0 && s.slot_shared[other] == 0) s.slot_shared[other] = 2;
}

// Slots under the window of each home.
template <typename T>
__global__ void __launch_bounds__(kThreads)
    neighbours_kernel(const __grid_constant__ SolverView<T> s) {
  if (!may_build(*s.clock)) return;
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  const int64_t h = i / kNeighbours;
  if (h >= s.clock->wanted_homes) return;
  const int n = static_cast<int>(i % kNeighbours);
  s.neighbour[h * kNeighbours + n] = slot_around(s, s.next_homes().coord + 4 * h, n);
}

// Destination of every particle; its cell is counted from the new home from now on.
template <typename T>
__global__ void __launch_bounds__(kThreads) place_kernel(const __grid_constant__ SolverView<T> s) {
  const SolverClock& clock = *s.clock;
  if (!may_build(clock) || int64_t(blockIdx.x) >= clock.homes) return;
  const HomeList<T>& homes = s.homes();
  const int32_t* coord = homes.coord + 4 * blockIdx.x;
  const int64_t first = homes.start[blockIdx.x], count = homes.count[blockIdx.x];
  for (int64_t r = threadIdx.x; r < count; r += kThreads) {
    const int64_t p = first + r;
    if (p < 0 || p >= s.count) continue;
    const int32_t h = s.table_home[s.entry[p]];
    const HomeList<T>& next = s.next_homes();
    const int64_t at = int64_t(next.start[h]) + s.place[p];
    const uint32_t meta = load_meta(s, p);
    int l[3];
    for (int axis = 0; axis < 3; ++axis)
      l[axis] = 4 * (coord[axis] - next.coord[4 * h + axis]) + meta_cell(meta, axis);
    store_meta(s, p, pack_meta(l[0], l[1], l[2], meta_row(meta)));
    s.entry[p] = static_cast<int32_t>(at < s.count ? at : s.count - 1);
  }
}

// source[at] = p, from entry (destination of p).
template <typename T>
__global__ void __launch_bounds__(kThreads) invert_kernel(const __grid_constant__ SolverView<T> s) {
  if (!may_build(*s.clock)) return;
  const int64_t p = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (p < s.count) s.place[s.entry[p]] = static_cast<int32_t>(p);
}

// Where the point of this word lies: of several ranks, which of them holds it and where; else the
// word is its place.
template <typename T>
__device__ const SolverView<T>& holder(const SolverView<T>& s, int32_t word, int64_t& place) {
  place = word;
  if (s.peers == nullptr) return s;
  const int bits = place_bits(s.ranks);
  place = uint32_t(word) & ((uint32_t(1) << bits) - 1);
  return s.peers[uint32_t(word) >> bits];
}

// Order inside a home: by rank in the cell, then by cell, so that neighbouring lanes add to
// different nodes. Cells with more than kRanks particles put the rest at the end. Leaves the
// present place of the particle that belongs at i in entry[i].
template <typename T>
__global__ void __launch_bounds__(kThreads) stripe_kernel(const __grid_constant__ SolverView<T> s) {
  const SolverClock& clock = *s.clock;
  if (!may_build(clock) || int64_t(blockIdx.x) >= clock.wanted_homes) return;
  const HomeList<T>& homes = s.next_homes();
  const int64_t first = homes.start[blockIdx.x], count = homes.count[blockIdx.x];
  int32_t* words = reinterpret_cast<int32_t*>(s.spare);
  __shared__ int32_t filled[kBlockNodes];
  __shared__ int32_t before[kRanks + 1];
  __shared__ unsigned long long cells[kRanks];
  __shared__ int32_t rest;
  for (int i = threadIdx.x; i < kBlockNodes; i += kThreads) filled[i] = 0;
  __syncthreads();
  for (int64_t r = threadIdx.x; r < count; r += kThreads) {
    int64_t p;
    const SolverView<T>& from = holder(s, s.place[first + r], p);
    const uint32_t meta = load_meta(from, p);
    const int cell = local_index(meta_cell(meta, 0) - 1 & 3, meta_cell(meta, 1) - 1 & 3,
                                 meta_cell(meta, 2) - 1 & 3);
    words[first + r] = atomicAdd(filled + cell, 1) << 6 | cell;
  }
  __syncthreads();
  for (int rank = threadIdx.x; rank < kRanks; rank += kThreads) {
    unsigned long long mask = 0;
    for (int c = 0; c < kBlockNodes; ++c) mask |= filled[c] > rank ? 1ull << c : 0ull;
    cells[rank] = mask;
  }
  __syncthreads();
  if (threadIdx.x == 0) {
    before[0] = 0;
    for (int rank = 0; rank < kRanks; ++rank)
      before[rank + 1] = before[rank] + __popcll(cells[rank]);
    rest = before[kRanks];
  }
  __syncthreads();
  for (int64_t r = threadIdx.x; r < count; r += kThreads) {
    const int32_t word = words[first + r];
    const int cell = word & 63, rank = word >> 6;
    const int32_t at = rank < kRanks
                           ? before[rank] + __popcll(cells[rank] & ((1ull << cell) - 1ull))
                           : atomicAdd(&rest, 1);
    s.entry[first + at] = s.place[first + r];
  }
}

// What one pass of the re-sort carries through `spare`, nine columns at most.
enum Pass : int { kPlacePass, kMotionPass, kStrainPass, kDeformationPass, kViscousPass, kOwnPass };

template <typename T>
GSF_HOST_DEVICE T* nine_of(const SolverView<T>& s, int pass) {
  return pass == kDeformationPass ? s.deformation : (pass == kViscousPass ? s.viscous : s.own);
}

// Calls f(array of a, array of b) for the arrays of a pass, the widest elements first.
template <typename T, typename F>
__device__ void for_pass(const SolverView<T>& a, const SolverView<T>& b, int pass, F&& f) {
  if (pass == kPlacePass) {
    f(quad_plane(a, a.offset, 0), quad_plane(b, b.offset, 0));
    f(quad_plane(a, a.velocity, 0), quad_plane(b, b.velocity, 0));
    f(a.id, b.id);
  }
  if (pass == kMotionPass)
    for (const int g : {1, 2}) f(quad_plane(a, a.velocity, g), quad_plane(b, b.velocity, g));
  if (pass == kStrainPass) {
    f(quad_plane(a, a.strain, 0), quad_plane(b, b.strain, 0));
    f(strain_pairs(a), strain_pairs(b));
    if (a.alpha != nullptr) {
      f(a.alpha, b.alpha);
      f(a.peak, b.peak);
    }
  }
  if (pass >= kDeformationPass) {
    T *to = nine_of(a, pass), *from = nine_of(b, pass);
    for (const int g : {0, 1}) f(quad_plane(a, to, g), quad_plane(b, from, g));
    f(to + 8 * a.count, from + 8 * b.count);
  }
}
template <typename T>
bool has_pass(const SolverView<T>& s, int pass) {
  return pass < kDeformationPass || nine_of(s, pass) != nullptr;
}

template <typename T, bool kBack>
__global__ void __launch_bounds__(kThreads)
    carry_kernel(const __grid_constant__ SolverView<T> s, int pass) {
  if (!may_build(*s.clock)) return;
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= s.clock->cursor || i >= s.count) return;
  int64_t p = i;
  const SolverView<T>& from = kBack ? s : holder(s, s.entry[i], p);
  char* spare = reinterpret_cast<char*>(s.spare);
  for_pass(s, from, pass, [&](auto* to, auto* array) {
    auto* room = reinterpret_cast<decltype(array)>(spare);
    if constexpr (kBack)
      to[i] = room[i];
    else
      room[i] = array[p];
    spare += s.count * sizeof *array;
  });
}

// Largest contribution and mass of each home, for the units of its window, and whether the window
// touches shared blocks (noted in `place` and `entry`, whose other work is done).
template <typename T>
__global__ void __launch_bounds__(kThreads) bound_kernel(const __grid_constant__ SolverView<T> s) {
  const SolverClock& clock = *s.clock;
  if (!may_build(clock) || int64_t(blockIdx.x) >= clock.wanted_homes) return;
  const HomeList<T>& homes = s.next_homes();
  home_bounds(s, blockIdx.x, homes.start[blockIdx.x], homes.count[blockIdx.x]);
  if (s.moments == nullptr || threadIdx.x >= 32) return;
  const int32_t slot =
      threadIdx.x < kNeighbours ? s.neighbour[blockIdx.x * kNeighbours + threadIdx.x] : -1;
  const bool shared = slot >= 0 && slot < s.slot_capacity && s.slot_shared[slot] != 0;
  const bool any = __any_sync(kAllLanes, shared) != 0;
  if (threadIdx.x != 0) return;
  s.place[blockIdx.x] = any ? 1 : 0;
  if (any) s.entry[add(&s.clock->shared_homes, 1)] = static_cast<int32_t>(blockIdx.x);
}

template <typename T>
__global__ void finish_kernel(const __grid_constant__ SolverView<T> s) {
  SolverClock& c = *s.clock;
  if (!may_build(c)) return;
  c.parity = 1 - (c.parity & 1);
  c.homes = c.wanted_homes;
  c.slots = c.wanted_slots;
  c.homes_max = max(c.homes_max, c.homes);
  c.slots_max = max(c.slots_max, c.slots);
  c.builds += 1;
  c.rebuild = 0;
  c.travel = 0.0;
  if (wants_damage(s)) c.grow = 1;
  if (s.peers == nullptr || c.homes > 0) return;
  for (int64_t i = 0; i < kMailWords + s.collider_count * kImpulseSums; ++i)
    s.mail[i] = 0;  // nobody else tells for a rank without points
}

inline unsigned ctas(int64_t n) { return static_cast<unsigned>((n + kThreads - 1) / kThreads); }

}  // namespace
}  // namespace gsf::cuda
