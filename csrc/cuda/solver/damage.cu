// Phase-field matter on the GPU: the damage field of a step, then g2p with its law. On the CPU:
// cpu/solver/damage.h; what both do: core/solver/damage.h.
//
// The field hangs on nothing that p2g and the nodes do, and so runs beside them, on a part of each
// multiprocessor. One kernel does all of it, and its CTAs wait for each other between the parts (a
// cooperative launch): most of its time is waiting, which the others fill. Where nothing is near
// its threshold it ends at once. Lists are in whatever order; sums are whole numbers, and a node is
// relaxed from nodes of the other colour.
#include <cooperative_groups.h>

#include <map>
#include <mutex>

#include "cuda/solver/g2p.h"

namespace gsf::cuda {
namespace {

// Threads of a CTA, of which each multiprocessor runs one: half of its registers are left to p2g.
constexpr int kDamageThreads = 512, kDamageShare = 2;
// Groups of a CTA, each of which takes a home after the other: while one waits for memory or for
// its last thread, the others add. By one home a CTA at a time the sums took two to four times as
// long as the relaxation (H200).
constexpr int kGroups = 4, kGroupThreads = kDamageThreads / kGroups;

struct Group {
  int index, thread;

  // A barrier named by a variable would take all sixteen of a CTA.
  __device__ void sync() const {
    static_assert(kGroups == 4 && kGroupThreads == 128);
    if (index == 0)
      asm volatile("bar.sync 1, 128;" ::: "memory");
    else if (index == 1)
      asm volatile("bar.sync 2, 128;" ::: "memory");
    else if (index == 2)
      asm volatile("bar.sync 3, 128;" ::: "memory");
    else
      asm volatile("bar.sync 4, 128;" ::: "memory");
  }
};

// Sums of a window in shared memory. There the GPU adds 32 bits at once, but 64 in a loop. In
// float, whose units leave 41 bits to a point (ops/solver_state.py), each sum has two words. The
// history, whose range is wide, goes into both, 21 bits and what is above. Else one word takes what
// is below 2^28 units, rounded to 2^7, and the other what is more, rounded to 2^18: an addend is
// off by 2^-11 of itself at most, and mostly by far less. The words have room for so many points of
// at most 0.43 of 41 bits.
constexpr int kLowBits = 21, kSmallBits = 28, kSmallDropped = 7, kDropped = 18, kChunk = 1 << 10;
constexpr double kWhole = 4503599627370496.0;  // 2^52: what is added to it is rounded to a whole
__device__ inline uint64_t whole_of(double v) {
  return static_cast<uint64_t>(__double_as_longlong(v + kWhole)) & ((uint64_t(1) << 52) - 1);
}
template <typename T>
struct DamageTile {
  unsigned low[kDamageSums][kTile], high[kDamageSums][kTile];
  __device__ void clear(int thread, int threads) {
    for (int i = thread; i < kDamageSums * kTile; i += threads)
      (&low[0][0])[i] = (&high[0][0])[i] = 0;
  }
  __device__ void add(int c, int at, double v) {
    if (c == kDriveSum) {
      const uint64_t units = whole_of(v);
      const unsigned below = static_cast<unsigned>(units) & ((1u << kLowBits) - 1u);
      const unsigned above = static_cast<unsigned>(units >> kLowBits);
      if (below != 0) atomicAdd(&low[c][at], below);
      if (above != 0) atomicAdd(&high[c][at], above);
      return;
    }
    const bool small = v < double(1 << kSmallBits);
    const double per_unit = small ? 1.0 / double(1 << kSmallDropped) : 1.0 / double(1 << kDropped);
    atomicAdd(small ? &low[c][at] : &high[c][at], static_cast<unsigned>(whole_of(v * per_unit)));
  }
  __device__ long long sum(int c, int at) const {
    const long long below = low[c][at], above = high[c][at];
    if (c == kDriveSum) return (above << kLowBits) + below;
    return (above << kDropped) + (below << kSmallDropped);
  }
};
template <>
struct DamageTile<double> {
  unsigned long long words[kDamageSums][kTile];
  __device__ void clear(int thread, int threads) {
    for (int i = thread; i < kDamageSums * kTile; i += threads) (&words[0][0])[i] = 0;
  }
  __device__ void add(int c, int at, double v) {
    atomicAdd(&words[c][at], static_cast<unsigned long long>(__double2ll_rn(v)));
  }
  __device__ long long sum(int c, int at) const { return static_cast<long long>(words[c][at]); }
};

template <typename T>
constexpr int kTileBytes = kGroups * static_cast<int>(sizeof(DamageTile<T>));
static_assert(sizeof(DamageTile<double>) >= kTile * sizeof(double));

// Of the 27 blocks around a home, those that the stencil of a point touches.
__device__ uint32_t blocks_touched(uint32_t meta) {
  uint32_t row = 1u;  // one bit for each block so far: of x, then of x and y, then of all
  for (int axis = 0; axis < 3; ++axis) {
    const int l = min(meta_cell(meta, axis), kLastCell);
    uint32_t next = 0;
    for (int n = 0; n < (axis == 0 ? 1 : (axis == 1 ? 3 : 9)); ++n)
      if ((row >> n & 1u) != 0)
        next |= 1u << (3 * n + window_block(l)) | 1u << (3 * n + window_block(l + 2));
    row = next;
  }
  return row;
}

// After a build slots have other numbers.
template <typename T>
__global__ void __launch_bounds__(kSolverThreads)
    unmark_kernel(const __grid_constant__ SolverView<T> s) {
  if (!may_build(*s.clock)) return;
  const int64_t i = int64_t(blockIdx.x) * kSolverThreads + threadIdx.x;
  if (i < s.slot_capacity)
    for (const int plane : {kHotPlane, kActivePlane})
      s.damage_slots[plane * s.slot_capacity + i] = 0;
  if (i <= kHomeCount) s.damage_counts[i] = 0;
}
template <typename T>
__global__ void __launch_bounds__(kSolverThreads)
    mark_kernel(const __grid_constant__ SolverView<T> s) {
  const SolverClock& clock = *s.clock;
  if (!may_build(clock) || int64_t(blockIdx.x) >= clock.wanted_homes) return;
  const HomeList<T>& homes = s.next_homes();
  const int64_t first = homes.start[blockIdx.x], count = homes.count[blockIdx.x];
  const int32_t* neighbour = s.neighbour + int64_t(blockIdx.x) * kNeighbours;
  const T active = active_alpha<T>(s.damage_scale[kScaleAt2] != 0.0);
  for (int64_t r = threadIdx.x; r < count; r += kSolverThreads) {
    const int64_t p = first + r;
    if (p < 0 || p >= s.count || !takes_part(s.alpha[p], s.peak[p], active)) continue;
    const uint32_t meta = load_meta(s, p);
    if (s.law[s.row_of(meta)] == kPhaseField)
      mark_slot(s, neighbour, meta, damage_stamp(clock.step));
  }
}

// What the parts of the solve share.
template <typename T>
struct Solve {
  const SolverView<T>& s;
  int32_t stamp;
  int64_t thread, threads;  // of the whole grid

  __device__ int32_t* plane(int which) const { return s.damage_slots + which * s.slot_capacity; }
  __device__ bool active(int32_t slot) const {
    return slot >= 0 && slot < s.slot_capacity && plane(kActivePlane)[slot] == stamp;
  }
  __device__ DamageNode* nodes(int64_t slot) const {
    return reinterpret_cast<DamageNode*>(s.damage_nodes) + slot * kBlockNodes;
  }
  // Stiffness of a node: where all matter has one length it goes with the volume, and points do not
  // give it.
  __device__ double stiff_of(const int64_t* units) const {
    const double even = s.damage_scale[kScaleStiff];
    return even != 0.0 ? double(units[kVolumeSum]) * s.damage_scale[kVolumeSum] * even
                       : double(units[kStiffSum]) * s.damage_scale[kStiffSum];
  }
  // Slot beyond face f of a slot, where `inside` is not this one; below 0: what stands there.
  __device__ int32_t beyond(int32_t slot, int f, bool inside) const {
    return inside ? slot : plane(kFaces + f)[slot];
  }

  // Homes that nobody has taken yet go to the next group that asks. The same for all its threads.
  template <typename F>
  __device__ void for_homes(const Group& group, const F& f) const {
    __shared__ int next[kGroups];
    const int homes = s.damage_counts[kHomeCount];
    for (;;) {
      if (group.thread == 0) next[group.index] = atomicAdd(s.damage_counts + kNextHome, 1);
      group.sync();
      const int i = next[group.index];
      group.sync();
      if (i >= homes) return;
      f(s.damage_homes[i]);
    }
  }

  // Slots of points to solve for and those around them.
  __device__ void spread() const {
    if (thread == 0) s.damage_counts[kHomeCount] = s.damage_counts[kNextHome] = 0;
    const int64_t work = int64_t(s.damage_counts[kHotCount]) * kNeighbours;
    for (int64_t i = thread; i < work; i += threads) {
      const int64_t hot = plane(kHotList)[i / kNeighbours];
      const int32_t slot =
          slot_around(s, s.slot_coord + 4 * hot, static_cast<int>(i % kNeighbours));
      if (slot < 0 || slot >= s.slot_capacity) continue;
      if (atomicExch(plane(kActivePlane) + slot, stamp) == stamp) continue;
      plane(kActiveList)[atomicAdd(s.damage_counts + kActiveCount, 1)] = slot;
    }
  }

  // Homes that meet them, what lies beyond their faces; their sums are cleared.
  __device__ void list() const {
    if (thread == 0) s.damage_counts[kHotCount] = 0;
    const int lane = static_cast<int>(threadIdx.x & 31u);
    for (int64_t h = thread / 32; h < s.clock->homes; h += threads / 32) {  // a warp for each
      const bool meets = lane < kNeighbours && active(s.neighbour[h * kNeighbours + lane]);
      if (__any_sync(kAllLanes, meets) && lane == 0)
        s.damage_homes[atomicAdd(s.damage_counts + kHomeCount, 1)] = static_cast<int32_t>(h);
    }
    const int64_t slots = s.damage_counts[kActiveCount];
    for (int64_t i = thread; i < slots * kBlockNodes; i += threads) {
      const int64_t node =
          int64_t(plane(kActiveList)[i / kBlockNodes]) * kBlockNodes + i % kBlockNodes;
      longlong2* words = reinterpret_cast<longlong2*>(s.damage_sums + kDamageSums * node);
      words[0] = words[1] = longlong2{0, 0};
    }
    for (int64_t i = thread; i < slots * 6; i += threads) {
      const int32_t slot = plane(kActiveList)[i / 6];
      const int f = static_cast<int>(i % 6);
      const int32_t other = slot_around(s, s.slot_coord + 4 * int64_t(slot), face_block(f));
      plane(kFaces + f)[slot] = other < 0 ? kNoBlock : (active(other) ? other : kUndamaged);
    }
  }

  // Sums of the points of one home, by a group.
  __device__ void scatter(int64_t home, const Group& group, DamageTile<T>& tile) const {
    const int32_t* neighbour = s.neighbour + home * kNeighbours;
    const int lane = static_cast<int>(threadIdx.x & 31u);
    const uint32_t wanted = __ballot_sync(kAllLanes, lane < kNeighbours && active(neighbour[lane]));
    const HomeList<T>& homes = s.homes();
    const int64_t first = homes.start[home];
    const int64_t count = first < 0 ? 0 : min(int64_t(homes.count[home]), s.count - first);
    double per_unit[kDamageSums];
    for (int c = 0; c < kDamageSums; ++c) per_unit[c] = 1.0 / s.damage_scale[c];
    for (int64_t begin = 0; begin < count; begin += kChunk) {
      tile.clear(group.thread, kGroupThreads);
      group.sync();
      const int64_t end = min(begin + int64_t(kChunk), count);
      for (int64_t r = begin + group.thread; r < end; r += kGroupThreads)
        give(first + r, wanted, per_unit, tile);
      group.sync();
      for (int index = group.thread; index < kWindowNodes; index += kGroupThreads) {
        int i, j, k;
        const int at = window_node(index, i, j, k);
        if ((wanted >> neighbour_of(i, j, k) & 1u) == 0) continue;
        int64_t* sums = s.damage_sums + kDamageSums * slot_node(neighbour, i, j, k);
        for (int c = 0; c < kDamageSums; ++c)
          if (const long long v = tile.sum(c, at); v != 0) add_units(sums + c, v);
      }
      group.sync();
    }
  }
  __device__ void give(int64_t p, uint32_t wanted, const double (&per_unit)[kDamageSums],
                       DamageTile<T>& tile) const {
    T offset[3];
    const uint32_t meta = load_place(s, p, offset);
    if ((blocks_touched(meta) & wanted) == 0) return;
    const uint32_t row = s.row_of(meta);
    if (s.law[row] != kPhaseField) return;
    double given[kDamageSums];
    const T* r = s.rows + int64_t(row) * kRowColumns;
    damage_given(double(r[kStressColumn]), double(r[4]) * double(s.inv_dx), double(s.alpha[p]),
                 double(s.peak[p]), given);
    for (int c = 0; c < kDamageSums; ++c) given[c] *= per_unit[c];
    if (s.damage_scale[kScaleStiff] != 0.0) given[kStiffSum] = 0.0;
    const Stencil<T> st = stencil_at(offset);
    const int base = window_base(meta);
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) {
        const double across = double(st.w[0][i] * st.w[1][j]);
        for (int k = 0; k < 3; ++k) {
          const double w = across * double(st.w[2][k]);
          const int at = base + i * kStrideX + j * kStrideY + k;
          for (int c = 0; c < kDamageSums; ++c)
            if (given[c] != 0.0) tile.add(c, at, w * given[c]);
        }
      }
  }

  // The equation of every node.
  __device__ void prepare() const {
    const bool at2 = s.damage_scale[kScaleAt2] != 0.0;
    const double empty = s.damage_scale[kScaleEmpty];
    double unit[kDamageSums];
    for (int c = 0; c < kDamageSums; ++c) unit[c] = s.damage_scale[c];
    const int64_t work = int64_t(s.damage_counts[kActiveCount]) * kBlockNodes;
    for (int64_t i = thread; i < work; i += threads) {
      const int32_t slot = plane(kActiveList)[i / kBlockNodes];
      const int local = static_cast<int>(i % kBlockNodes);
      const int64_t* units = s.damage_sums + kDamageSums * (int64_t(slot) * kBlockNodes + local);
      double sums[kDamageSums];
      for (int c = 0; c < kDamageSums; ++c) sums[c] = double(units[c]) * unit[c];
      sums[kStiffSum] = stiff_of(units);
      nodes(slot)[local] = damage_node(sums, at2, empty, [&](int f) {
        bool inside;
        const int there = face_node(local, f, inside);
        const int32_t other = beyond(slot, f, inside);
        if (other < 0) return other == kUndamaged ? sums[kStiffSum] : 0.0;
        const int64_t* far = s.damage_sums + kDamageSums * (int64_t(other) * kBlockNodes + there);
        if (!(double(far[kVolumeSum]) * unit[kVolumeSum] > empty)) return 0.0;
        return edge_weight(sums[kStiffSum], stiff_of(far));
      });
    }
  }

  // One colour once. Nodes without matter hold 0, and so pull at nobody.
  __device__ void relax(int colour) const {
    const int64_t work = int64_t(s.damage_counts[kActiveCount]) * (kBlockNodes / 2);
    for (int64_t i = thread; i < work; i += threads) {
      const int32_t slot = plane(kActiveList)[i / (kBlockNodes / 2)];
      const int even = 2 * static_cast<int>(i % (kBlockNodes / 2));
      const int local = even + (node_colour(even) != colour ? 1 : 0);
      DamageNode& node = nodes(slot)[local];
      const DamageNode now = node;
      if (now.inverse == 0.0) continue;
      double sum = now.right;
      for (int f = 0; f < 6; ++f) {
        bool inside;
        const int there = face_node(local, f, inside);
        const int32_t other = beyond(slot, f, inside);
        if (other < 0) continue;
        const DamageNode& far = nodes(other)[there];
        sum += edge_weight(now.stiff, far.stiff) * far.value;
      }
      node.value = relaxed(now.value, sum, now.inverse);
    }
  }

  // prepare and all sweeps where there is a thread for every node: it keeps its equation, and only
  // values go through memory. The same sums in the same order.
  __device__ void solve_held(const cooperative_groups::grid_group& all) const {
    const bool at2 = s.damage_scale[kScaleAt2] != 0.0;
    const double empty = s.damage_scale[kScaleEmpty];
    const double volume_unit = s.damage_scale[kVolumeSum];
    const bool mine = thread < int64_t(s.damage_counts[kActiveCount]) * kBlockNodes;
    const int local = static_cast<int>(thread % kBlockNodes);
    double weight[6] = {}, right = 0.0, inverse = 0.0, value = 0.0;
    const double* near[6] = {};
    double* own = nullptr;
    if (mine) {
      const int32_t slot = plane(kActiveList)[thread / kBlockNodes];
      const int64_t* units = s.damage_sums + kDamageSums * (int64_t(slot) * kBlockNodes + local);
      double sums[kDamageSums];
      for (int c = 0; c < kDamageSums; ++c) sums[c] = double(units[c]) * s.damage_scale[c];
      sums[kStiffSum] = stiff_of(units);
      own = &nodes(slot)[local].value;
      const DamageNode node = damage_node(sums, at2, empty, [&](int f) {
        bool inside;
        const int there = face_node(local, f, inside);
        const int32_t other = beyond(slot, f, inside);
        near[f] = own;
        if (other < 0) return other == kUndamaged ? sums[kStiffSum] : 0.0;
        const int64_t* far = s.damage_sums + kDamageSums * (int64_t(other) * kBlockNodes + there);
        if (!(double(far[kVolumeSum]) * volume_unit > empty)) return 0.0;
        near[f] = &nodes(other)[there].value;
        return weight[f] = edge_weight(sums[kStiffSum], stiff_of(far));
      });
      value = node.value;
      right = node.right;
      inverse = node.inverse;
      *own = value;
    }
    const int colour = node_colour(local);
    for (int half = 0; half < 2 * kSweeps; ++half) {
      all.sync();
      if (inverse == 0.0 || colour != half % 2) continue;
      double sum = right;
      for (int f = 0; f < 6; ++f) sum += weight[f] * *near[f];
      value = relaxed(value, sum, inverse);
      *own = value;
    }
  }

  // The field back to the points of one home, by a CTA.
  __device__ void gather(int64_t home, const Group& group, T* tile) const {
    const int32_t* neighbour = s.neighbour + home * kNeighbours;
    for (int index = group.thread; index < kWindowNodes; index += kGroupThreads) {
      int i, j, k;
      const int at = window_node(index, i, j, k);
      const int32_t slot = neighbour[neighbour_of(i, j, k)];
      const int local = local_index(window_local(i), window_local(j), window_local(k));
      tile[at] = active(slot) ? T(nodes(slot)[local].value) : T(0);
    }
    group.sync();
    const HomeList<T>& homes = s.homes();
    const int64_t first = homes.start[home];
    const int64_t count = min(int64_t(homes.count[home]), s.count - first);
    for (int64_t r = group.thread; first >= 0 && r < count; r += kGroupThreads) {
      const int64_t p = first + r;
      T offset[3];
      const uint32_t meta = load_place(s, p, offset);
      if (s.law[s.row_of(meta)] != kPhaseField) continue;
      const Stencil<T> st = stencil_at(offset);
      const int base = window_base(meta);
      T found(0);
      for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
          const T* f = tile + base + i * kStrideX + j * kStrideY;
          found +=
              st.w[0][i] * st.w[1][j] * (st.w[2][0] * f[0] + st.w[2][1] * f[1] + st.w[2][2] * f[2]);
        }
      const T peak = s.peak[p], now = peak_after(peak, found);
      if (now != peak) s.peak[p] = now;
    }
  }
};

template <typename T>
__global__ void __launch_bounds__(kDamageThreads, kDamageShare)
    damage_kernel(const __grid_constant__ SolverView<T> s) {
  // The same for all CTAs: nobody writes these before all have come to the first wait.
  if (!may_step(*s.clock) || s.damage_counts[kHotCount] == 0) return;
  extern __shared__ __align__(16) char shared[];
  DamageTile<T>* tiles = reinterpret_cast<DamageTile<T>*>(shared);
  const Group group{static_cast<int>(threadIdx.x) / kGroupThreads,
                    static_cast<int>(threadIdx.x) % kGroupThreads};
  const cooperative_groups::grid_group all = cooperative_groups::this_grid();
  const Solve<T> solve{s, damage_stamp(s.clock->step),
                       int64_t(blockIdx.x) * kDamageThreads + threadIdx.x,
                       int64_t(gridDim.x) * kDamageThreads};
  solve.spread();
  all.sync();
  solve.list();
  all.sync();
  solve.for_homes(group, [&](int64_t home) { solve.scatter(home, group, tiles[group.index]); });
  all.sync();
  if (solve.thread == 0) s.damage_counts[kNextHome] = 0;
  if (int64_t(s.damage_counts[kActiveCount]) * kBlockNodes <= solve.threads) {
    solve.solve_held(all);
  } else {
    solve.prepare();
    for (int half = 0; half < 2 * kSweeps; ++half) {
      all.sync();
      solve.relax(half % 2);
    }
  }
  all.sync();
  if (solve.thread == 0) s.damage_counts[kActiveCount] = 0;
  T* field = reinterpret_cast<T*>(tiles + group.index);
  solve.for_homes(group, [&](int64_t home) { solve.gather(home, group, field); });
}

// A stream beside that of a step, ahead of it where both want a multiprocessor, and the events at
// which they part and meet. One of each for every device and kind of state, since steps of several
// kinds may be captured at once.
template <typename T>
struct Beside {
  cudaStream_t stream = nullptr;
  cudaEvent_t parted = nullptr, done = nullptr;

  static const Beside& here() {
    static std::map<int, Beside> all;
    static std::mutex mutex;
    int device = 0;
    cudaGetDevice(&device);
    const std::lock_guard<std::mutex> lock(mutex);
    const auto [found, is_new] = all.try_emplace(device);
    Beside& b = found->second;
    if (is_new) {
      int least = 0, greatest = 0;
      cudaDeviceGetStreamPriorityRange(&least, &greatest);
      cudaStreamCreateWithPriority(&b.stream, cudaStreamNonBlocking, greatest);
      cudaEventCreateWithFlags(&b.parted, cudaEventDisableTiming);
      cudaEventCreateWithFlags(&b.done, cudaEventDisableTiming);
      cudaFuncSetAttribute(damage_kernel<T>, cudaFuncAttributeMaxDynamicSharedMemorySize,
                           kTileBytes<T>);
    }
    return b;
  }
};

}  // namespace

template <typename T>
void solver_damage_marks(const SolverView<T>& s, cudaStream_t stream) {
  const unsigned slots =
      static_cast<unsigned>((s.slot_capacity + kSolverThreads - 1) / kSolverThreads);
  unmark_kernel<T><<<slots, kSolverThreads, 0, stream>>>(s);
  mark_kernel<T><<<static_cast<unsigned>(s.home_capacity), kSolverThreads, 0, stream>>>(s);
}

// solver_step asks for errors.
template <typename T>
void solver_damage_begin(const SolverView<T>& s, cudaStream_t stream) {
  int device = 0, processors = 1;
  cudaGetDevice(&device);
  cudaDeviceGetAttribute(&processors, cudaDevAttrMultiProcessorCount, device);
  const Beside<T>& beside = Beside<T>::here();
  cudaEventRecord(beside.parted, stream);
  cudaStreamWaitEvent(beside.stream, beside.parted, 0);
  const unsigned homes = static_cast<unsigned>(s.home_capacity);
  cudaLaunchAttribute together{};
  together.id = cudaLaunchAttributeCooperative;
  together.val.cooperative = 1;
  cudaLaunchConfig_t config{};
  config.gridDim = dim3(min(homes, static_cast<unsigned>(processors)));
  config.blockDim = dim3(kDamageThreads);
  config.dynamicSmemBytes = kTileBytes<T>;
  config.stream = beside.stream;
  config.attrs = &together;
  config.numAttrs = 1;
  cudaLaunchKernelEx(&config, damage_kernel<T>, s);
  cudaEventRecord(beside.done, beside.stream);
}

template <typename T>
void solver_damage_end(const SolverView<T>& s, bool begun, cudaStream_t stream) {
  if (begun) cudaStreamWaitEvent(stream, Beside<T>::here().done, 0);
  launch_g2p<T, kDamageField, false>(s, stream);
}

#define GSF_INSTANTIATE(T)                                                  \
  template void solver_damage_marks<T>(const SolverView<T>&, cudaStream_t); \
  template void solver_damage_begin<T>(const SolverView<T>&, cudaStream_t); \
  template void solver_damage_end<T>(const SolverView<T>&, bool, cudaStream_t);
GSF_INSTANTIATE(float)
GSF_INSTANTIATE(double)
#undef GSF_INSTANTIATE

}  // namespace gsf::cuda
