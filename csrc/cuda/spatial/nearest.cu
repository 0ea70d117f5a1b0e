// The nearest points of places: a table of cells for a level at a time, a warp for a query.
#include <climits>

#include "core/nearest.h"
#include "cuda/spatial/launch.h"
#include "cuda/threads.h"

namespace gsf::cuda {
namespace {

constexpr unsigned kAll = ~0u;

// Whether the levels before have left nothing to do.
__device__ bool idle(const NearestArgs& a, int level) {
  return level > 0 && a.left[level - 1] == 0;
}

__global__ void begin_kernel(NearestArgs a) {
  const int64_t i = thread_number();
  if (i < a.queries) a.done[i] = 0;
  if (i < kNearestLevels) a.left[i] = a.used[i] = 0;
  if (i < 6) a.box[i] = ordered(i < 3 ? HUGE_VAL : -HUGE_VAL);
}

__global__ void box_kernel(NearestArgs a) {
  const int64_t i = thread_number();
  const bool there = i < a.points && finite_place(a.point + 3 * i);
  for (int axis = 0; axis < 3; ++axis) {
    long long low = there ? ordered(a.point[3 * i + axis]) : LLONG_MAX;
    long long high = there ? low : LLONG_MIN;
    for (int step = 16; step; step /= 2) {
      low = min(low, __shfl_xor_sync(kAll, low, step));
      high = max(high, __shfl_xor_sync(kAll, high, step));
    }
    if (threadIdx.x % 32 || low > high) continue;
    atomicMin(reinterpret_cast<long long*>(a.box + axis), low);
    atomicMax(reinterpret_cast<long long*>(a.box + axis + 3), high);
  }
}

__global__ void clear_kernel(NearestArgs a, int level) {
  if (idle(a, level)) return;
  const int64_t b = thread_number();
  if (b < a.buckets) a.count[b] = 0;
}

__global__ void count_kernel(NearestArgs a, int level) {
  const int64_t i = thread_number();
  if (idle(a, level) || i >= a.points) return;
  const int64_t bucket = bucket_of_point(a, i, level_cell(a, level));
  if (bucket >= 0) atomicAdd(a.count + bucket, 1);
}

// Places for every bucket, in the order in which they ask: what lies where does not matter.
__global__ void place_kernel(NearestArgs a, int level) {
  const int64_t b = thread_number();
  if (idle(a, level) || b >= a.buckets || a.count[b] == 0) return;
  a.end[b] = int32_t(atomicAdd(a.used + level, static_cast<unsigned long long>(a.count[b])));
}

__global__ void fill_kernel(NearestArgs a, int level) {
  const int64_t i = thread_number();
  if (idle(a, level) || i >= a.points) return;
  const int64_t bucket = bucket_of_point(a, i, level_cell(a, level));
  if (bucket >= 0) a.row[atomicAdd(a.end + bucket, 1)] = int32_t(i);
}

// The best of a query that wants more than one: its first lane keeps the list.
struct Many {
  const NearestList& list;
  double worst = HUGE_VAL;
  int64_t last = -1;
  __device__ void take(bool there, int64_t row, double away) {
    unsigned left = __ballot_sync(kAll, there && nearer(away, row, worst, last));
    while (left) {
      const int source = __ffs(left) - 1;
      const int64_t its = __shfl_sync(kAll, row, source);
      const double far = __shfl_sync(kAll, away, source);
      if (threadIdx.x % 32 == 0) {
        list.take(its, far);
        worst = list.square[list.wanted - 1];
        last = list.index[list.wanted - 1];
      }
      worst = __shfl_sync(kAll, worst, 0);
      last = __shfl_sync(kAll, last, 0);
      left &= left - 1;
      left &= __ballot_sync(kAll, there && nearer(away, row, worst, last));
    }
  }
  __device__ void agree() {}
};

// Of one that wants one: each lane keeps its own until a ring has been seen.
struct One {
  const NearestList& list;
  double worst = HUGE_VAL;
  int64_t last = INT64_MAX;
  __device__ void take(bool there, int64_t row, double away) {
    if (!there || !nearer(away, row, worst, last)) return;
    worst = away;
    last = row;
  }
  __device__ void agree() {
    for (int step = 16; step; step /= 2) {
      const double away = __shfl_xor_sync(kAll, worst, step);
      const int64_t row = __shfl_xor_sync(kAll, last, step);
      take(true, row, away);
    }
    if (threadIdx.x % 32 || worst == HUGE_VAL) return;
    list.square[0] = worst;
    list.index[0] = last;
  }
};

// Asks the points of a ring of cells. 32 cells are looked up at once, and their points asked 32 at
// a time whatever cell they are of.
template <class Best>
__device__ void ask_ring(const NearestArgs& a, int64_t i, const int64_t* middle, double edge,
                         int ring, double reach, Best& best) {
  const int lane = threadIdx.x % 32, side = 2 * ring + 1;
  for (int base = 0; base < side * side * side; base += 32) {
    int64_t cell[3];
    unsigned many = 0, first = 0;
    if (base + lane < side * side * side && cell_of_ring(middle, ring, base + lane, cell) &&
        square_to_cell(a.query + 3 * i, cell, edge) <= fmin(best.worst, reach)) {
      const int64_t bucket = bucket_of(a, cell, group_of(a.asked, i));
      many = unsigned(a.count[bucket]);
      first = unsigned(a.end[bucket]) - many;
    }
    unsigned upto = many;
    for (int step = 1; step < 32; step *= 2) {
      const unsigned before = __shfl_up_sync(kAll, upto, step);
      if (lane >= step) upto += before;
    }
    const unsigned all = __shfl_sync(kAll, upto, 31);
    for (unsigned from = 0; from < all; from += 32) {
      const unsigned place = from + lane;
      int source = 0;  // the lane whose cell holds it
      for (int step = 16; step; step /= 2)
        if (__shfl_sync(kAll, upto, source + step - 1) <= place) source += step;
      source = min(source, 31);
      const unsigned before = __shfl_sync(kAll, upto - many, source);
      const unsigned start = __shfl_sync(kAll, first, source);
      int64_t row = 0, its[3];
      double away = HUGE_VAL;
      bool there = place < all;
      if (there) {
        row = a.row[start + (place - before)];
        cell_of_ring(middle, ring, base + source, its);
        there = candidate(a, i, row, its, edge, best.worst, best.last, &away);
      }
      best.take(there, row, away);
    }
  }
  best.agree();
}

template <class Best>
__global__ void query_kernel(NearestArgs a, int level) {
  const int64_t i = thread_number() / 32;
  if (idle(a, level) || i >= a.queries || a.done[i]) return;  // whole warps
  const NearestList list(a, i);
  const int lane = threadIdx.x % 32;
  if (lane == 0) list.clear();
  const double edge = level_cell(a, level), reach = a.reach * a.reach * (1.0 + kCellSlack);
  bool done = level == kNearestLevels - 1 || !finite_place(a.query + 3 * i);
  int64_t middle[3];
  if (cell_at(a.query + 3 * i, edge, middle)) {
    Best best{list};
    for (int ring = 0; ring <= kNearestRings && !(done && ring); ++ring) {
      ask_ring(a, i, middle, edge, ring, reach, best);
      done = done || settled(a, i, best.worst, ring * edge * (1.0 - kCellSlack));
    }
  }
  if (lane) return;
  a.done[i] = done;
  if (done)
    list.finish(a.reach);
  else
    atomicAdd(a.left + level, 1ull);
}

}  // namespace

cudaError_t nearest_points(const NearestArgs& a, cudaStream_t stream) {
  if (a.queries == 0) return cudaSuccess;
  const int64_t first = a.queries > kNearestLevels ? a.queries : kNearestLevels;
  begin_kernel<<<blocks_for(first), kThreads, 0, stream>>>(a);
  if (a.points) box_kernel<<<blocks_for(a.points), kThreads, 0, stream>>>(a);
  for (int level = 0; level < kNearestLevels; ++level) {
    clear_kernel<<<blocks_for(a.buckets), kThreads, 0, stream>>>(a, level);
    if (a.points) {
      count_kernel<<<blocks_for(a.points), kThreads, 0, stream>>>(a, level);
      place_kernel<<<blocks_for(a.buckets), kThreads, 0, stream>>>(a, level);
      fill_kernel<<<blocks_for(a.points), kThreads, 0, stream>>>(a, level);
    }
    if (a.wanted == 1)
      query_kernel<One><<<blocks_for(32 * a.queries), kThreads, 0, stream>>>(a, level);
    else
      query_kernel<Many><<<blocks_for(32 * a.queries), kThreads, 0, stream>>>(a, level);
    if (level == 0) continue;  // two levels serve most: the host looks after them
    unsigned long long left = 0;
    cudaError_t error =
        cudaMemcpyAsync(&left, a.left + level, sizeof left, cudaMemcpyDeviceToHost, stream);
    if (error == cudaSuccess) error = cudaStreamSynchronize(stream);
    if (error != cudaSuccess || left == 0) return error;
  }
  return cudaGetLastError();
}

}  // namespace gsf::cuda
