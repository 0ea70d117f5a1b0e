// Builds of several ranks. The view of all makes the lists of blocks from what the ranks' points
// need; each rank then takes its share of them and fetches the points of its homes from wherever
// they lie. Kernels read and write what lies on other devices as if it were their own; between such
// phases all wait for all (Fleet::meet).
#include "cuda/ranks/ranks.h"
#include "cuda/solver/build.h"

namespace gsf::cuda {
namespace {

constexpr int kCutThreads = 1024;
constexpr int kBins = 4096;  // of the order of homes along the longest axis

// What the points of a rank need joins what those of the others do. A point's place in its home
// follows those of the ranks that were there first.
template <typename T>
__global__ void __launch_bounds__(kThreads) join_kernel(const __grid_constant__ SolverView<T> s,
                                                        const __grid_constant__ SolverView<T> all) {
  SolverClock& clock = *all.clock;
  if (!may_build(clock)) return;
  const int64_t e = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (e == 0) {
    if (s.clock->reason != kFine) clock.reason = s.clock->reason;
    if (s.clock->wanted_homes != 0) clock.wanted_homes = s.clock->wanted_homes;
  }
  if (e >= s.table_size || s.table_count[e] == 0) return;
  const int32_t joined = insert<true>(all, s.key[e]);
  s.table_home[e] = joined;
  if (joined < 0) {
    clock.wanted_homes = all.table_size;
    return;
  }
  s.table_slot[e] = atomicAdd_system(all.table_count + joined, s.table_count[e]);
  atomicOr_system(reinterpret_cast<uint32_t*>(all.table_mask + joined), uint32_t(s.table_mask[e]));
}

// Cuts across the longest axis, and within a layer of blocks across the second: the rank that owns
// each home. Each has about as many points. If one has no room for its share, all stop before
// anything has changed, and the clocks of the ranks say what they want. One CTA.
template <typename T>
__global__ void __launch_bounds__(kCutThreads) cut_kernel(const __grid_constant__ SolverView<T> s) {
  SolverClock& clock = *s.clock;
  if (!may_build(clock)) return;
  const HomeList<T>& homes = s.next_homes();
  const int64_t count = clock.wanted_homes;
  __shared__ int low[3], high[3];
  __shared__ int filled[kBins], sums[kCutThreads];
  __shared__ int points_of[kMostRanks], homes_of_rank[kMostRanks];
  for (int i = threadIdx.x; i < kBins; i += kCutThreads) filled[i] = 0;
  for (int r = threadIdx.x; r < s.ranks; r += kCutThreads) points_of[r] = homes_of_rank[r] = 0;
  if (threadIdx.x < 3) {
    low[threadIdx.x] = kBlockRange;
    high[threadIdx.x] = -kBlockRange;
  }
  __syncthreads();
  const int4* blocks = reinterpret_cast<const int4*>(homes.coord);
  int least[3] = {kBlockRange, kBlockRange, kBlockRange};
  int most[3] = {-kBlockRange, -kBlockRange, -kBlockRange};
#pragma unroll 4
  for (int64_t h = threadIdx.x; h < count; h += kCutThreads) {
    const int4 b = blocks[h];
    const int at[3] = {b.x, b.y, b.z};
    for (int i = 0; i < 3; ++i) {
      least[i] = min(least[i], at[i]);
      most[i] = max(most[i], at[i]);
    }
  }
  for (int i = 0; i < 3; ++i) {
    atomicMin(low + i, __reduce_min_sync(kAllLanes, least[i]));
    atomicMax(high + i, __reduce_max_sync(kAllLanes, most[i]));
  }
  __syncthreads();
  int axis[3] = {0, 1, 2};  // longest first
  const auto extent = [&](int i) { return int64_t(high[axis[i]]) - low[axis[i]] + 1; };
  for (const int i : {0, 1, 0})
    if (extent(i + 1) > extent(i)) {
      const int longer = axis[i + 1];
      axis[i + 1] = axis[i];
      axis[i] = longer;
    }
  // 32 bits hold them: blocks lie in a range of 2^17, and there are at most 2^12 bins.
  const uint32_t extents[2] = {uint32_t(extent(0)), uint32_t(extent(1))};
  const uint32_t layers = min(extents[0], uint32_t(kBins));
  const uint32_t rows = min(extents[1], kBins / layers);
  const auto bin = [&](const int4& b) {
    const int c[3] = {b.x, b.y, b.z};
    return uint32_t(c[axis[0]] - low[axis[0]]) * layers / extents[0] * rows +
           uint32_t(c[axis[1]] - low[axis[1]]) * rows / extents[1];
  };
#pragma unroll 4
  for (int64_t h = threadIdx.x; h < count; h += kCutThreads)
    atomicAdd(filled + bin(blocks[h]), homes.count[h]);
  __syncthreads();
  // Points before each bin.
  constexpr int kEach = kBins / kCutThreads;
  int own = 0;
  for (int i = 0; i < kEach; ++i) own += filled[kEach * threadIdx.x + i];
  sums[threadIdx.x] = own;
  __syncthreads();
  for (int step = 1; step < kCutThreads; step *= 2) {
    const int before = int(threadIdx.x) >= step ? sums[threadIdx.x - step] : 0;
    __syncthreads();
    sums[threadIdx.x] += before;
    __syncthreads();
  }
  int before = sums[threadIdx.x] - own;
  for (int i = 0; i < kEach; ++i) {
    const int here = filled[kEach * threadIdx.x + i];
    filled[kEach * threadIdx.x + i] = before;
    if (here > 0) atomicAdd(points_of + int64_t(before) * s.ranks / s.total, here);
    before += here;
  }
  __syncthreads();
  for (int64_t h = threadIdx.x; h < count; h += kCutThreads) {
    const int32_t rank = static_cast<int32_t>(int64_t(filled[bin(blocks[h])]) * s.ranks / s.total);
    s.home_rank[h] = rank;
    const unsigned alike = __match_any_sync(__activemask(), rank);
    if (int(threadIdx.x % 32) == __ffs(alike) - 1) atomicAdd(homes_of_rank + rank, __popc(alike));
  }
  __syncthreads();
  for (int r = threadIdx.x; r < s.ranks; r += kCutThreads) {
    SolverClock& wants = *s.peers[r].clock;
    wants.cursor = points_of[r];
    wants.wanted_homes = homes_of_rank[r];
    if (points_of[r] > s.peers[r].count || homes_of_rank[r] > s.peers[r].home_capacity)
      clock.grow = 1;
  }
}

// A rank begins with the clock of all and its own homes.
template <typename T>
__global__ void begin_kernel(const __grid_constant__ SolverView<T> s,
                             const __grid_constant__ SolverView<T> all) {
  SolverClock now = *all.clock;
  now.homes = s.clock->homes;
  now.slots = s.clock->slots;
  now.cursor = s.clock->cursor;
  now.plastic = now.guarded = now.inverted = now.invalid = 0;
  *s.clock = now;
}

// A rank hears how the build went and has no homes yet.
template <typename T>
__global__ void hear_kernel(const __grid_constant__ SolverView<T> s,
                            const __grid_constant__ SolverView<T> all) {
  SolverClock& c = *s.clock;
  if (!may_build(c)) return;
  c.grow = all.clock->grow;
  c.reason = all.clock->reason;
  if (c.grow != 0) return;  // what this rank wants stands in its clock
  c.wanted_homes = c.wanted_slots = c.cursor = c.shared_sites = c.shared_homes = 0;
}

// The homes that a rank owns.
template <typename T>
__global__ void __launch_bounds__(kThreads) take_kernel(const __grid_constant__ SolverView<T> s,
                                                        const __grid_constant__ SolverView<T> all) {
  if (!may_build(*s.clock)) return;
  const int64_t h = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (h >= all.clock->wanted_homes || all.home_rank[h] != s.rank) return;
  const HomeList<T>&from = all.next_homes(), &to = s.next_homes();
  const int32_t points = from.count[h];
  const int64_t own = static_cast<int64_t>(add(&s.clock->wanted_homes, 1));
  const int64_t start = static_cast<int64_t>(add(&s.clock->cursor, points));
  for (int i = 0; i < 4; ++i) to.coord[4 * own + i] = from.coord[4 * h + i];
  to.start[own] = static_cast<int32_t>(start);
  to.count[own] = points;
  all.home_place[h] = static_cast<int32_t>(start);
}

// As place_kernel: where each point of a rank goes, rank and place in one word.
template <typename T>
__global__ void __launch_bounds__(kThreads) send_kernel(const __grid_constant__ SolverView<T> s,
                                                        const __grid_constant__ SolverView<T> all) {
  const SolverClock& clock = *s.clock;
  if (!may_build(clock) || int64_t(blockIdx.x) >= clock.homes) return;
  const int32_t* coord = s.homes().coord + 4 * blockIdx.x;
  const int64_t first = s.homes().start[blockIdx.x], count = s.homes().count[blockIdx.x];
  const int bits = place_bits(s.ranks);
  for (int64_t r = threadIdx.x; r < count; r += kThreads) {
    const int64_t p = first + r;
    const int32_t e = s.entry[p], h = all.table_home[s.table_home[e]];
    const int64_t at = int64_t(all.home_place[h]) + s.table_slot[e] + s.place[p];
    const int32_t* to = all.next_homes().coord + 4 * int64_t(h);
    const uint32_t meta = load_meta(s, p);
    int l[3];
    for (int axis = 0; axis < 3; ++axis)
      l[axis] = 4 * (coord[axis] - to[axis]) + meta_cell(meta, axis);
    store_meta(s, p, pack_meta(l[0], l[1], l[2], meta_row(meta)));
    s.entry[p] = static_cast<int32_t>(uint32_t(all.home_rank[h]) << bits | uint32_t(at));
  }
}

// As invert_kernel: the rank that a point goes to learns where it lies.
template <typename T>
__global__ void __launch_bounds__(kThreads) offer_kernel(const __grid_constant__ SolverView<T> s) {
  const SolverClock& clock = *s.clock;
  if (!may_build(clock) || int64_t(blockIdx.x) >= clock.homes) return;
  const int64_t first = s.homes().start[blockIdx.x], count = s.homes().count[blockIdx.x];
  const int bits = place_bits(s.ranks);
  for (int64_t r = threadIdx.x; r < count; r += kThreads) {
    int64_t at;
    const SolverView<T>& to = holder(s, s.entry[first + r], at);
    to.place[at] = static_cast<int32_t>(uint32_t(s.rank) << bits | uint32_t(first + r));
  }
}

// The lists of blocks of all become the rank's own; so do its lists of slots and sites, later.
template <typename T>
__global__ void __launch_bounds__(kThreads) copy_kernel(const __grid_constant__ SolverView<T> s,
                                                        const __grid_constant__ SolverView<T> all) {
  if (!may_build(*s.clock)) return;
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i < s.table_size) {
    s.key[i] = all.key[i];
    s.table_slot[i] = all.table_slot[i];
  }
  if (i >= all.clock->wanted_slots) return;
  for (int c = 0; c < 4; ++c) s.slot_coord[4 * i + c] = all.slot_coord[4 * i + c];
  for (int f = 0; f < kSiteFields; ++f)
    s.site_slots[kSiteFields * i + f] = all.site_slots[kSiteFields * i + f];
  s.slot_shared[i] = all.slot_shared[i];
  s.slot_near[i] = all.slot_near[i];
  s.slot_next[i] = all.slot_next[i];
}

__device__ void join_bits(uint64_t* to, uint64_t bits) {
  if ((*to & bits) != bits)
    atomicOr_system(reinterpret_cast<unsigned long long*>(to),
                    static_cast<unsigned long long>(bits));
}

template <typename T>
__global__ void __launch_bounds__(kThreads) free_kernel(const __grid_constant__ SolverView<T> s) {
  const int64_t slot = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (may_build(*s.clock) && slot < s.slot_capacity) s.holders[slot] = s.needers[slot] = 0;
}

// A rank needs the slots under the windows of its homes.
template <typename T>
__global__ void __launch_bounds__(kThreads) need_kernel(const __grid_constant__ SolverView<T> s,
                                                        const __grid_constant__ SolverView<T> all) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (!may_build(*s.clock) || i >= s.clock->wanted_homes * kNeighbours) return;
  const int32_t slot = s.neighbour[i];
  if (slot >= 0) join_bits(all.needers + slot, uint64_t(1) << s.rank);
}

// Who needs a slot of a site needs all of them: it does contact there. It holds them, and around
// those that fields share the sums that contact reads. One thread for each site and neighbour.
template <typename T>
__global__ void __launch_bounds__(kThreads) hold_kernel(const __grid_constant__ SolverView<T> s) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  const int64_t site = i / kNeighbours;
  if (!may_build(*s.clock) || site >= s.clock->sites) return;
  const int32_t* slots = s.site_slots + kSiteFields * site;
  if (slots[1] < 0 && i % kNeighbours != 0) return;  // one field: nobody reads around it
  uint64_t ranks = 0;
  int count = 0;
  for (; count < kSiteFields && slots[count] >= 0; ++count) ranks |= s.needers[slots[count]];
  for (int f = 0; f < count; ++f) {
    join_bits(s.needers + slots[f], ranks);
    join_bits(s.holders + slots[f], ranks);
    if (count == 1) return;
    const int32_t near =
        slot_around(s, s.slot_coord + 4 * int64_t(slots[f]), static_cast<int>(i % kNeighbours));
    if (near >= 0) join_bits(s.holders + near, ranks);
  }
}

// What a rank holds of all slots (in `table_count`, whose other work is done), and the shared sites
// that it needs.
template <typename T>
__global__ void __launch_bounds__(kThreads) list_kernel(const __grid_constant__ SolverView<T> s,
                                                        const __grid_constant__ SolverView<T> all) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (!may_build(*s.clock)) return;
  if (i < all.clock->wanted_slots) {
    const uint64_t holders = all.holders[i];
    s.holders[i] = holders;
    s.needers[i] = all.needers[i];
    if ((holders >> s.rank & 1u) != 0)
      s.table_count[add(&s.clock->wanted_slots, 1)] = static_cast<int32_t>(i);
  }
  if (i >= all.clock->shared_sites) return;
  const int32_t site = all.table_mask[i];
  if ((all.needers[all.site_slots[kSiteFields * int64_t(site)]] >> s.rank & 1u) != 0)
    s.table_mask[add(&s.clock->shared_sites, 1)] = site;
}

}  // namespace

template <typename T>
cudaError_t ranks_prime(const Fleet<T>& fleet, int law_set) {
  const SolverView<T>& all = fleet.all();
  cudaError_t error = cudaSuccess;
  const auto meet = [&] {
    const cudaError_t met = fleet.meet();
    if (error == cudaSuccess) error = met;
  };
  meet();
  fleet.each([&](const SolverView<T>& s, cudaStream_t stream) {
    begin_kernel<T><<<1, 1, 0, stream>>>(s, all);
  });
  for (const bool measure : {true, false}) {
    fleet.each([&](const SolverView<T>& s, cudaStream_t stream) {
      solver_prime_points(s, law_set, measure, stream);
    });
    meet();
    const auto start = [&](const SolverView<T>& s, cudaStream_t stream) {
      solver_start(s, measure, stream);
    };
    fleet.each(start);
    fleet.of_all(start);
    meet();
  }
  return error == cudaSuccess ? cudaGetLastError() : error;
}

template <typename T>
cudaError_t ranks_build(const Fleet<T>& fleet) {
  const SolverView<T>& all = fleet.all();
  const unsigned table = ctas(all.table_size), slots = ctas(all.slot_capacity);
  const unsigned homes_of_all = ctas(all.home_capacity);
  const auto homes = [](const SolverView<T>& s) { return static_cast<unsigned>(s.home_capacity); };
  const auto around = [](const SolverView<T>& s) { return ctas(s.home_capacity * kNeighbours); };
  cudaError_t error = cudaSuccess;
  const auto meet = [&] {
    const cudaError_t met = fleet.meet();
    if (error == cudaSuccess) error = met;
  };
  const auto clear = [&](const SolverView<T>& s, cudaStream_t stream) {
    clear_kernel<T><<<table, kThreads, 0, stream>>>(s);
  };
  fleet.of_all(clear);
  fleet.each([&](const SolverView<T>& s, cudaStream_t stream) {
    clear(s, stream);
    insert_kernel<T><<<homes(s), kThreads, 0, stream>>>(s);
  });
  meet();
  fleet.each([&](const SolverView<T>& s, cudaStream_t stream) {
    join_kernel<T><<<table, kThreads, 0, stream>>>(s, all);
  });
  meet();
  fleet.of_all([&](const SolverView<T>& s, cudaStream_t stream) {
    homes_kernel<T><<<table, kThreads, 0, stream>>>(s);
    slots_kernel<T><<<table, kThreads, 0, stream>>>(s);
    verdict_kernel<T><<<1, 1, 0, stream>>>(s);
    sites_kernel<T><<<table, kThreads, 0, stream>>>(s);
    if (s.moments != nullptr)
      edges_kernel<T><<<ctas(s.slot_capacity * kNeighbours), kThreads, 0, stream>>>(s);
    cut_kernel<T><<<1, kCutThreads, 0, stream>>>(s);
    free_kernel<T><<<slots, kThreads, 0, stream>>>(s);
  });
  meet();
  fleet.each([&](const SolverView<T>& s, cudaStream_t stream) {
    hear_kernel<T><<<1, 1, 0, stream>>>(s, all);
    take_kernel<T><<<homes_of_all, kThreads, 0, stream>>>(s, all);
  });
  meet();
  fleet.each([&](const SolverView<T>& s, cudaStream_t stream) {
    send_kernel<T><<<homes(s), kThreads, 0, stream>>>(s, all);
    copy_kernel<T><<<table, kThreads, 0, stream>>>(s, all);
    neighbours_kernel<T><<<around(s), kThreads, 0, stream>>>(s);
    need_kernel<T><<<around(s), kThreads, 0, stream>>>(s, all);
  });
  meet();
  fleet.each([&](const SolverView<T>& s, cudaStream_t stream) {
    offer_kernel<T><<<homes(s), kThreads, 0, stream>>>(s);
  });
  fleet.of_all([&](const SolverView<T>& s, cudaStream_t stream) {
    hold_kernel<T><<<ctas(s.slot_capacity * kNeighbours), kThreads, 0, stream>>>(s);
  });
  meet();
  fleet.each([&](const SolverView<T>& s, cudaStream_t stream) {
    list_kernel<T><<<slots, kThreads, 0, stream>>>(s, all);
    stripe_kernel<T><<<homes(s), kThreads, 0, stream>>>(s);
  });
  for (int pass = kPlacePass; pass <= kOwnPass; ++pass) {
    if (!has_pass(fleet.views[0], pass)) continue;
    fleet.each([&](const SolverView<T>& s, cudaStream_t stream) {
      carry_kernel<T, false><<<ctas(s.count), kThreads, 0, stream>>>(s, pass);
    });
    meet();
    fleet.each([&](const SolverView<T>& s, cudaStream_t stream) {
      carry_kernel<T, true><<<ctas(s.count), kThreads, 0, stream>>>(s, pass);
    });
  }
  fleet.each([&](const SolverView<T>& s, cudaStream_t stream) {
    bound_kernel<T><<<homes(s), kThreads, 0, stream>>>(s);
    finish_kernel<T><<<1, 1, 0, stream>>>(s);
  });
  fleet.of_all([&](const SolverView<T>& s, cudaStream_t stream) {
    finish_kernel<T><<<1, 1, 0, stream>>>(s);
  });
  meet();
  return error == cudaSuccess ? cudaGetLastError() : error;
}

template <typename T>
cudaError_t ranks_step(const Fleet<T>& fleet, int law_set) {
  cudaError_t error = cudaSuccess;
  const auto meet = [&] {
    const cudaError_t met = fleet.meet();
    if (error == cudaSuccess) error = met;
  };
  if (fleet.views[0].own != nullptr) {
    fleet.each(
        [](const SolverView<T>& s, cudaStream_t stream) { solver_free_to_nodes(s, stream); });
    meet();
    fleet.each([](const SolverView<T>& s, cudaStream_t stream) { solver_free_nodes(s, stream); });
    meet();
  }
  for (int part = 0; part < points_parts(fleet.views[0]); ++part) {
    fleet.each(
        [&](const SolverView<T>& s, cudaStream_t stream) { solver_points(s, part, stream); });
    meet();
  }
  fleet.each([](const SolverView<T>& s, cudaStream_t stream) { solver_to_nodes(s, stream); });
  meet();
  fleet.each(
      [&](const SolverView<T>& s, cudaStream_t stream) { solver_from_nodes(s, law_set, stream); });
  meet();
  fleet.each([&](const SolverView<T>& s, cudaStream_t stream) {
    solver_end(s, s.rank == fleet.beside_all(), stream);
  });
  return error == cudaSuccess ? cudaGetLastError() : error;
}

#define GSF_INSTANTIATE(T)                                   \
  template cudaError_t ranks_prime<T>(const Fleet<T>&, int); \
  template cudaError_t ranks_build<T>(const Fleet<T>&);      \
  template cudaError_t ranks_step<T>(const Fleet<T>&, int);
GSF_INSTANTIATE(float)
GSF_INSTANTIATE(double)
#undef GSF_INSTANTIATE

}  // namespace gsf::cuda
