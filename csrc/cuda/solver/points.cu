// Points of the resident solver that colliders push, and points of different objects that push each
// other (core/solver/points.h): what they get in a step goes to the nodes about them as sums of
// whole numbers, apart from the other sums, and the kernels of the nodes take it in. No order of
// points or threads changes a bit. On the CPU: cpu/solver/surface.h, cpu/contact/points.h.
//
// Points that could touch another object are listed by cell in every step. The first of a cell
// stands, plus one, in the fourth word of the node velocity at the cell's lower corner: nothing
// else is there, and the kernels of the nodes put a 0 behind every velocity. What points are given
// and have found lies in `spare`, which nobody needs between two builds.
#include "cuda/solver/p2g.h"

namespace gsf::cuda {
namespace {

constexpr int kThreads = 128;
// Units of the sums over the points near one: of a share, and of a stiffness and a force over the
// largest; of a rate times the longest step. Room for 8192 and 2^19 of them.
constexpr double kShareUnit = 0x1p-50, kRateUnit = 0x1p-44;

template <typename T>
__device__ double longest_step(const SolverView<T>& s) {
  return spring_step(*s.clock, s.spring_rows[2 * s.row_count], double(s.dx));
}

// The fastest wave of all rows, then what others see of a point of each row.
template <typename T>
__global__ void __launch_bounds__(kThreads)
    rows_kernel(const __grid_constant__ SolverView<T> s, bool waves) {
  const int64_t row = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (row >= s.row_count) return;
  double* largest = s.spring_rows + 2 * s.row_count;
  if (waves) {
    raise_real(largest, row_wave(s, row));
    return;
  }
  const TouchMatter matter = touch_matter(s, row, longest_step(s));
  s.spring_rows[2 * row] = matter.volume;
  s.spring_rows[2 * row + 1] = matter.stiffness;
  raise_real(largest + 1, matter.stiffness);
}

// What `spare` holds between two builds, 32 of its 36 bytes per point (float).
template <typename T>
struct Room {
  Quad<T>* given;    // [N] impulse and how much it may rub [N s]
  double* energy;    // [N] of those that may touch another object
  int32_t* next;     // [N] of the list of their cell, or -1
  unsigned* filled;  // [homes] bits of the largest number that a point of a home is given

  __device__ explicit Room(const SolverView<T>& s)
      : given(reinterpret_cast<Quad<T>*>(s.spare)),
        energy(reinterpret_cast<double*>(given + s.count)),
        next(reinterpret_cast<int32_t*>(energy + s.count)),
        filled(reinterpret_cast<unsigned*>(next + s.count)) {}
};
// The first point of a cell, plus one.
template <typename T>
__device__ int32_t* cell_head(const SolverView<T>& s, int64_t node) {
  return reinterpret_cast<int32_t*>(s.node_velocity + 4 * node + 3);
}

// Range of the points of a home, and the slots under its window.
template <typename T>
struct HomeRange {
  int64_t first, count;

  __device__ HomeRange(const SolverView<T>& s, int64_t home) {
    first = s.homes().start[home];
    count = first >= 0 ? min(int64_t(s.homes().count[home]), s.count - first) : 0;
  }
};
template <typename T>
__device__ void load_slots(const SolverView<T>& s, int64_t home, int32_t* neighbour) {
  if (threadIdx.x >= kNeighbours) return;
  const int32_t slot = s.neighbour[home * kNeighbours + threadIdx.x];
  neighbour[threadIdx.x] = slot < s.slot_capacity ? slot : -1;
}

// Keeps what a point is given; the largest number of it.
template <typename T>
__device__ float keep_given(const Room<T>& room, int64_t p, const T* given) {
  room.given[p] = {given[0], given[1], given[2], given[3]};
  float most = 0.0f;
  for (int c = 0; c < 4; ++c) most = larger(float(fabs(given[c])), most);
  return most;
}
// Before a home's points are given anything, and after some of them were, whole warps together: the
// largest number.
template <typename T>
__device__ void clear_home(const Room<T>& room, int64_t home) {
  if (threadIdx.x == 0) room.filled[home] = 0;
}
template <typename T>
__device__ void note_given(const SolverView<T>& s, int which, int64_t home, float most) {
  const unsigned bits = __reduce_max_sync(kAllLanes, sortable(most * 1.000001f));
  if (bits == 0 || (threadIdx.x & 31) != 0) return;
  atomicMax(Room<T>(s).filled + home, bits);
  raise_to(given_bound(s, which), bits);
}

template <typename T>
__device__ void note_slot(const SolverView<T>& s, int which, int64_t slot) {
  int32_t* note = s.slot_given + slot;
  if ((*static_cast<volatile int32_t*>(note) >> which & 1) == 0) atomicOr_system(note, 1 << which);
}
// Of several ranks: the largest number that any of them gives.
template <typename T>
__global__ void agree_kernel(const __grid_constant__ SolverView<T> s, int which) {
  if (!may_step(*s.clock)) return;
  for (int q = 0; q < s.ranks; ++q)
    raise_to(given_bound(s, which), static_cast<unsigned>(*given_bound(s.peers[q], which)));
}

// Adds what the points of a home are given to the nodes of its window, which has a unit of its own
// as in p2g.h.
template <typename T>
struct GivenWindow {
  typename Fixed<T>::Word sums[4][kTile];
  int32_t neighbour[kNeighbours];
};
template <typename T>
__device__ void scatter_home(const SolverView<T>& s, int which, int64_t home,
                             GivenWindow<T>& window) {
  const Room<T> room(s);
  const unsigned filled = room.filled[home];
  if (filled == 0) return;
  for (int i = threadIdx.x; i < 4 * kTile; i += kThreads) (&window.sums[0][0])[i] = 0;
  load_slots(s, home, window.neighbour);
  __syncthreads();
  const HomeRange<T> range(s, home);
  const double step_unit = given_unit(s, which);
  const double unit = window_unit<T>(double(__uint_as_float(filled)), 0.43, range.count, step_unit);
  const int shift = ilogb(unit) - ilogb(step_unit);
  const T per_unit = T(1.0 / unit);
  for (int64_t r = threadIdx.x; r < range.count; r += kThreads) {
    const Quad<T> q = room.given[range.first + r];
    const T given[4] = {q.x, q.y, q.z, q.w};
    if (given[0] == T(0) && given[1] == T(0) && given[2] == T(0)) continue;
    T offset[3];
    const int base = window_base(load_place(s, range.first + r, offset));
    const Stencil<T> st = stencil_at(offset);
    for_each_node([&](int i, int j, int k) {
      const T w = st.weight(i, j, k) * per_unit;
      for (int c = 0; c < 4; ++c)
        Fixed<T>::add(&window.sums[c][base + i * kStrideX + j * kStrideY + k],
                      Fixed<T>::round(w * given[c]));
    });
  }
  __syncthreads();
  for (int index = threadIdx.x; index < kWindowNodes; index += kThreads) {
    int i, j, k;
    const int at = window_node(index, i, j, k);
    const int64_t node = slot_node(window.neighbour, i, j, k);
    if (node < 0) continue;
    const auto units = [&](int c) { return to_units(window.sums[c][at], shift); };
    if ((units(0) | units(1) | units(2) | units(3)) == 0) continue;
    give_node<4>(s, node, units,
                 [&](const SolverView<T>& v) { return which == kPush ? v.push : v.press; });
    note_slot(s, which, node / kBlockNodes);
    for_others_of(s, s.peers == nullptr ? 0 : s.holders[node / kBlockNodes],
                  [&](const SolverView<T>& v) { note_slot(v, which, node / kBlockNodes); });
  }
}

// Radius of a point [m], and the share of a push that is left while it parts.
template <typename T>
__device__ double surface_of(const SolverView<T>& s, int64_t p, double& kept) {
  const int64_t id = s.id[p];
  const bool known = id >= 0 && id < s.total;
  kept = known ? double(s.radius[2 * id + 1]) : 1.0;
  return known ? double(s.radius[2 * id]) : 0.0;
}

// Friction beyond this holds all the same; the unit of the sums is for less.
constexpr double kFrictionMost = 1e6;

// What colliders give.
template <typename T>
__global__ void __launch_bounds__(kThreads) push_kernel(const __grid_constant__ SolverView<T> s) {
  const SolverClock& clock = *s.clock;
  const int64_t home = blockIdx.x;
  if (!may_step(clock) || home >= min(clock.homes, s.count)) return;
  __shared__ unsigned long long near;  // as slot_near: bit 63 stands for all the others
  const Room<T> room(s);
  clear_home(room, home);
  if (threadIdx.x == 0) near = 0;
  __syncthreads();
  const int32_t* block = s.homes().coord + 4 * home;
  const Vec3<double> middle = home_middle(s, block);
  for (int64_t k = threadIdx.x; k < s.collider_count; k += kThreads)
    if (pushes_points(s, k) &&
        collider_clearance(s.collider_state + k * kColliderColumns, s.sdf, middle) <= home_reach(s))
      atomicOr(&near, 1ull << min(k, int64_t(63)));
  __syncthreads();
  if (near == 0) return;
  const HomeRange<T> range(s, home);
  const double dx = double(s.dx), longest = longest_step(s);
  float most = 0.0f;
  for (int64_t r = threadIdx.x; r < range.count; r += kThreads) {
    const int64_t p = range.first + r;
    T offset[3], given[4] = {T(0), T(0), T(0), T(0)};
    const uint32_t meta = load_place(s, p, offset);
    PushedPoint<T> point;
    for (int axis = 0; axis < 3; ++axis)
      point.x[axis] = (4.0 * block[axis] - 0.5 + meta_cell(meta, axis) + double(offset[axis])) * dx;
    load_speed(s, p, point.velocity);
    point.radius = surface_of(s, p, point.kept);
    point.row = s.row_of(meta);
    for (unsigned long long left = near; left != 0; left &= left - 1) {
      const int64_t first = __ffsll(static_cast<long long>(left)) - 1;
      const int64_t end = first == 63 ? s.collider_count : first + 1;
      for (int64_t k = first; k < end; ++k)
        if (k < 63 || pushes_points(s, k)) push_point(s, k, point, longest, given);
    }
    const Vec3<T> j{given[0], given[1], given[2]};
    given[3] = T(fmin(double(given[3]), kFrictionMost * double(norm(j))));
    most = larger(keep_given(room, p, given), most);
  }
  note_given(s, kPush, home, most);
}
template <typename T>
__global__ void __launch_bounds__(kThreads)
    push_scatter_kernel(const __grid_constant__ SolverView<T> s) {
  __shared__ GivenWindow<T> window;
  if (may_step(*s.clock) && int64_t(blockIdx.x) < min(s.clock->homes, s.count))
    scatter_home(s, kPush, blockIdx.x, window);
}

// Which points of a home could touch another object: those with nodes in blocks that fields share.
template <typename T>
__device__ void load_shared(const SolverView<T>& s, const int32_t* neighbour, bool* shared) {
  if (threadIdx.x < kNeighbours) {
    const int32_t slot = neighbour[threadIdx.x];
    shared[threadIdx.x] = slot >= 0 && s.slot_shared[slot] == 1;
  }
}
__device__ bool may_touch(const bool* shared, uint32_t meta) {
  int low[3], high[3];
  for (int axis = 0; axis < 3; ++axis) {
    const int l = min(meta_cell(meta, axis), kLastCell);
    low[axis] = window_block(l);
    high[axis] = window_block(l + 2);
  }
  bool any = false;
  for (int i = low[0]; i <= high[0]; ++i)
    for (int j = low[1]; j <= high[1]; ++j)
      for (int k = low[2]; k <= high[2]; ++k) any = any || shared[(i * 3 + j) * 3 + k];
  return any;
}

// Calls f(view) of those whose points may lie in cells of a slot: the ranks that need it.
template <typename T, typename F>
__device__ void for_needers(const SolverView<T>& s, int64_t slot, const F& f) {
  if (s.peers == nullptr) return f(s);
  for (uint64_t left = s.needers[slot]; left != 0; left &= left - 1)
    f(s.peers[__ffsll(static_cast<long long>(left)) - 1]);
}

// Calls f(home, part) for the 2^shift parts of the homes whose windows touch shared blocks, whole
// CTAs together. bound_kernel has listed them in `entry`.
template <typename T, typename F>
__device__ void for_shared_homes(const SolverView<T>& s, int shift, const F& f) {
  const SolverClock& clock = *s.clock;
  if (!may_step(clock)) return;
  for (int64_t i = blockIdx.x; i < min(clock.shared_homes, s.count) << shift; i += gridDim.x) {
    const int64_t home = s.entry[i >> shift];
    if (home >= 0 && home < min(min(clock.homes, s.count), s.home_capacity))
      f(home, static_cast<int>(i & ((1 << shift) - 1)));
    __syncthreads();  // what lies in shared memory is used again
  }
}
// Walks through lists wait for memory, so many threads wait at once: a home's points are given to
// 2^kSplit CTAs, and kTeam threads of a warp share what is near a point. Their sums are whole
// numbers, so it does not matter who adds what.
constexpr int kSplit = 2, kTeam = 4;
__device__ inline long long team_sum(long long units) {
  const unsigned lane = threadIdx.x & 31u;
  const unsigned team = ((1u << kTeam) - 1u) << (lane & ~unsigned(kTeam - 1));
  for (int offset = kTeam / 2; offset > 0; offset /= 2)
    units += __shfl_xor_sync(team, units, offset);
  return units;
}

template <typename T>
__global__ void __launch_bounds__(kThreads) list_kernel(const __grid_constant__ SolverView<T> s) {
  __shared__ int32_t neighbour[kNeighbours];
  __shared__ bool shared[kNeighbours];
  for_shared_homes(s, 0, [&](int64_t home, int) {
    load_slots(s, home, neighbour);
    __syncthreads();
    load_shared(s, neighbour, shared);
    __syncthreads();
    const HomeRange<T> range(s, home);
    const Room<T> room(s);
    for (int64_t r = threadIdx.x; r < range.count; r += kThreads) {
      const int64_t p = range.first + r;
      const uint32_t meta = load_meta(s, p);
      if (!may_touch(shared, meta)) continue;
      const int64_t node =
          slot_node(neighbour, min(meta_cell(meta, 0), kLastCell),
                    min(meta_cell(meta, 1), kLastCell), min(meta_cell(meta, 2), kLastCell));
      if (node >= 0) room.next[p] = atomicExch(cell_head(s, node), static_cast<int32_t>(p + 1)) - 1;
    }
  });
}

// What a home's kernels need of the blocks around it.
struct Around {
  int32_t neighbour[kNeighbours];
  bool shared[kNeighbours];
  // slots of other objects in each block, and cells of the window that hold points of these, from
  // one before its first node
  int32_t others[kNeighbours], other[kNeighbours][kSiteFields];
  bool filled[kWindowNodes];
  int32_t active[kThreads], count;

  // Whole CTAs together; false when no point of another object is near.
  template <typename T>
  __device__ bool load(const SolverView<T>& s, int64_t home) {
    load_slots(s, home, neighbour);
    __syncthreads();
    load_shared(s, neighbour, shared);
    if (threadIdx.x < kNeighbours) {
      const int32_t* c = s.homes().coord + 4 * home;
      const int n = threadIdx.x;
      const int32_t e = find(
          s, block_key(c[0] + n / 9 - 1, c[1] + n / 3 % 3 - 1, c[2] + n % 3 - 1, kMaxSolverFields));
      int32_t slot = e >= 0 ? s.table_slot[e] : -1;
      int count = 0;
      for (int f = 0; f < kSiteFields && slot >= 0 && slot < s.slot_capacity; ++f) {
        if (s.touches_by_points(c[3], s.slot_coord[4 * int64_t(slot) + 3]))
          other[n][count++] = slot;
        slot = s.slot_next[slot];
      }
      others[n] = count;
    }
    __syncthreads();
    bool any = false;
    for (int index = threadIdx.x; index < kWindowNodes; index += kThreads) {
      const int at[3] = {index / 64 - 1, index / 8 % 8 - 1, index % 8 - 1};
      bool here = false;
      for_cell(at, [&](int64_t node) {
        for_needers(s, node / kBlockNodes,
                    [&](const SolverView<T>& v) { here = here || *cell_head(v, node) != 0; });
      });
      filled[index] = here;
      any = any || here;
    }
    return __syncthreads_or(any) != 0;
  }
  // Whether points of other objects may be within reach of one.
  __device__ bool reaches(uint32_t meta) const {
    if (!may_touch(shared, meta)) return false;
    bool any = false;
    for (int o = 0; o < kNeighbours; ++o) any = any || filled[cell(meta, o)];
    return any;
  }
  // Number of neighbour o of the cell of a point.
  __device__ static int cell(uint32_t meta, int o) {
    int index = 0;
    for (int axis = 0; axis < 3; ++axis)
      index = 8 * index + min(meta_cell(meta, axis), kLastCell) + neighbour_step(o, axis) + 1;
    return index;
  }
  // Calls f(point) for the points of a part of a home that this is true of, kTeam threads for each
  // of them together, and rest(point) for the others. Whole CTAs together.
  template <typename T, typename F, typename R>
  __device__ void for_points(const SolverView<T>& s, int64_t home, int part, const F& f,
                             const R& rest) {
    const HomeRange<T> range(s, home);
    for (int64_t at = part * kThreads; at < range.count; at += kThreads << kSplit) {
      if (threadIdx.x == 0) count = 0;
      __syncthreads();
      const int64_t r = at + threadIdx.x;
      if (r < range.count) {
        const int64_t p = range.first + r;
        if (reaches(load_meta(s, p)))
          active[atomicAdd(&count, 1)] = static_cast<int32_t>(p);
        else
          rest(p);
      }
      __syncthreads();
      for (int i = threadIdx.x / kTeam; i < count; i += kThreads / kTeam) f(int64_t(active[i]));
      __syncthreads();
    }
  }
  // Calls f(node) for the slots of other objects at a cell of the window, from -1 to 6.
  template <typename F>
  __device__ void for_cell(const int* at, const F& f) const {
    const int block = neighbour_of(at[0], at[1], at[2]);
    const int there = local_index(window_local(at[0]), window_local(at[1]), window_local(at[2]));
    for (int i = 0; i < others[block]; ++i) f(int64_t(other[block][i]) * kBlockNodes + there);
  }
};

// Calls f(view, q, d, r2) for the points of other objects near one, which `view` holds, those that
// fall to this thread of a team. The order is any.
template <typename T, typename F>
__device__ void for_others(const SolverView<T>& s, const Around& around, uint32_t meta,
                           const T* place, const F& f) {
  for (int o = threadIdx.x % kTeam; o < kNeighbours; o += kTeam) {
    if (!around.filled[Around::cell(meta, o)]) continue;
    int at[3];
    for (int axis = 0; axis < 3; ++axis)
      at[axis] = min(meta_cell(meta, axis), kLastCell) + neighbour_step(o, axis);
    const auto walk = [&](const SolverView<T>& v, int64_t node) {
      const int32_t* next = Room<T>(v).next;
      int64_t q = int64_t(*cell_head(v, node)) - 1;
      for (int64_t tries = 0; q >= 0 && q < v.count && tries < v.count; ++tries, q = next[q]) {
        T offset[3];
        load_place(v, q, offset);
        double d[3], r2 = 0.0;
        for (int axis = 0; axis < 3; ++axis) {
          d[axis] = double(place[axis]) - double(offset[axis]) - neighbour_step(o, axis);
          r2 += d[axis] * d[axis];
        }
        if (r2 < kTouchReach * kTouchReach) f(v, q, d, r2);
      }
    };
    around.for_cell(at, [&](int64_t node) {
      for_needers(s, node / kBlockNodes, [&](const SolverView<T>& v) { walk(v, node); });
    });
  }
}

template <typename T>
__device__ TouchMatter matter_of(const SolverView<T>& s, uint32_t meta) {
  const double* row = s.spring_rows + 2 * int64_t(s.row_of(meta));
  return {row[0], row[1]};
}
// A power of two above the largest stiffness [Pa].
template <typename T>
__device__ double stiffness_above(const SolverView<T>& s) {
  return power_above(fmax(s.spring_rows[2 * s.row_count + 1], 1e-30));
}
__device__ inline long long units_of(double value, double per_unit) {
  return __double2ll_rn(value * per_unit);
}

// How much of other objects the points find, and the energy that follows.
template <typename T>
__global__ void __launch_bounds__(kThreads) find_kernel(const __grid_constant__ SolverView<T> s) {
  __shared__ Around around;
  const Room<T> room(s);
  for_shared_homes(s, kSplit, [&](int64_t home, int part) {
    clear_home(room, home);
    if (!around.load(s, home)) return;
    const double dx = double(s.dx);
    const double stiffness_unit = kShareUnit * stiffness_above(s);
    const double rate_unit = kRateUnit / power_above(fmax(longest_step(s), 1e-30));
    const double per_stiffness = 1.0 / stiffness_unit, per_rate = 1.0 / rate_unit;
    const auto find = [&](int64_t p) {
      T place[3], speed[3];
      const uint32_t meta = load_place(s, p, place);
      load_speed(s, p, speed);
      const double velocity[3] = {double(speed[0]) / dx, double(speed[1]) / dx,
                                  double(speed[2]) / dx};
      long long share = 0, stiffness = 0, rate = 0;
      for_others(s, around, meta, place,
                 [&](const SolverView<T>& v, int64_t q, const double* d, double r2) {
                   T speed_q[3];
                   load_speed(v, q, speed_q);
                   const double velocity_q[3] = {double(speed_q[0]) / dx, double(speed_q[1]) / dx,
                                                 double(speed_q[2]) / dx};
                   TouchFound found{0.0, 0.0, 0.0};
                   add_found(matter_of(s, load_meta(v, q)), d, r2, velocity, velocity_q, found);
                   share += units_of(found.share, 1.0 / kShareUnit);
                   stiffness += units_of(found.stiffness, per_stiffness);
                   rate += units_of(found.rate, per_rate);
                 });
      share = team_sum(share);
      stiffness = team_sum(stiffness);
      rate = team_sum(rate);
      if (threadIdx.x % kTeam != 0) return;
      const TouchFound sum{double(share) * kShareUnit, double(stiffness) * stiffness_unit,
                           double(rate) * rate_unit};
      double energy = 0.0, kept;
      const double radius = surface_of(s, p, kept);
      if (share != 0)
        energy = touch_energy(matter_of(s, meta), touch_share(radius / dx),
                              spring_lag(row_wave(s, s.row_of(meta)), dx), kept, sum);
      room.energy[p] = energy;
    };
    around.for_points(s, home, part, find, [](int64_t) {});
  });
}

// What they get.
template <typename T>
__global__ void __launch_bounds__(kThreads) press_kernel(const __grid_constant__ SolverView<T> s) {
  __shared__ Around around;
  const Room<T> room(s);
  for_shared_homes(s, kSplit, [&](int64_t home, int part) {
    if (!around.load(s, home)) return;
    const double unit = kShareUnit * stiffness_above(s), per_unit = 1.0 / unit;
    float most = 0.0f;
    const auto press = [&](int64_t p) {
      T place[3];
      const uint32_t meta = load_place(s, p, place);
      long long units[3] = {0, 0, 0};
      const double energy = room.energy[p], volume = matter_of(s, meta).volume;
      for_others(s, around, meta, place,
                 [&](const SolverView<T>& v, int64_t q, const double* d, double r2) {
                   const double energy_q = Room<T>(v).energy[q];
                   if (energy == 0.0 && energy_q == 0.0) return;
                   const double force = touch_force(energy, volume, energy_q,
                                                    matter_of(s, load_meta(v, q)).volume, r2);
                   for (int axis = 0; axis < 3; ++axis)
                     units[axis] += units_of(force * d[axis], per_unit);
                 });
      double sum[3];
      T given[4];
      for (int axis = 0; axis < 3; ++axis) sum[axis] = double(team_sum(units[axis])) * unit;
      if (threadIdx.x % kTeam != 0) return;
      touch_given(sum, s.clock->dt, double(s.dx), given);
      most = larger(keep_given(room, p, given), most);
    };
    around.for_points(s, home, part, press,
                      [&](int64_t p) { room.given[p] = {T(0), T(0), T(0), T(0)}; });
    note_given(s, kPress, home, most);
  });
}
template <typename T>
__global__ void __launch_bounds__(kThreads)
    press_scatter_kernel(const __grid_constant__ SolverView<T> s) {
  __shared__ GivenWindow<T> window;
  for_shared_homes(s, 0, [&](int64_t home, int) { scatter_home(s, kPress, home, window); });
}

}  // namespace

template <typename T>
void solver_spring_rows(const SolverView<T>& s, cudaStream_t stream) {
  if (s.row_count == 0) return;
  const unsigned ctas = static_cast<unsigned>((s.row_count + kThreads - 1) / kThreads);
  cudaMemsetAsync(s.spring_rows + 2 * s.row_count, 0, 2 * sizeof(double), stream);
  for (const bool waves : {true, false}) rows_kernel<T><<<ctas, kThreads, 0, stream>>>(s, waves);
}

template <typename T>
void solver_points(const SolverView<T>& s, int part, cudaStream_t stream) {
  const unsigned homes = static_cast<unsigned>(s.home_capacity);
  const unsigned shared = min(homes, kSharedCtas), parts = min(homes << kSplit, kSharedCtas);
  const bool touch = points_parts(s) > 2;
  if (s.peers != nullptr && part % 2 == 1)
    agree_kernel<T><<<1, 1, 0, stream>>>(s, part == 1 ? kPush : kPress);
  if (part == 0) {
    cudaMemsetAsync(s.spring_rows + 2 * (s.row_count + 1), 0, 2 * sizeof(uint64_t), stream);
    cudaMemsetAsync(s.slot_given, 0, s.slot_capacity * sizeof *s.slot_given, stream);
    if (s.collider_count > 0) push_kernel<T><<<homes, kThreads, 0, stream>>>(s);
    if (touch) list_kernel<T><<<shared, kThreads, 0, stream>>>(s);
  } else if (part == 1) {
    if (s.collider_count > 0) push_scatter_kernel<T><<<homes, kThreads, 0, stream>>>(s);
    if (touch) find_kernel<T><<<parts, kThreads, 0, stream>>>(s);
  } else if (part == 2) {
    press_kernel<T><<<parts, kThreads, 0, stream>>>(s);
  } else {
    press_scatter_kernel<T><<<shared, kThreads, 0, stream>>>(s);
  }
}

#define GSF_INSTANTIATE(T)                                                 \
  template void solver_spring_rows<T>(const SolverView<T>&, cudaStream_t); \
  template void solver_points<T>(const SolverView<T>&, int, cudaStream_t);
GSF_INSTANTIATE(float)
GSF_INSTANTIATE(double)
#undef GSF_INSTANTIATE

}  // namespace gsf::cuda
