// build_blocks on the CPU: which 4x4x4-node blocks hold matter, and the particles in cell order
// (counting sort).
#include <algorithm>
#include <atomic>
#include <limits>

#include "core/mpm/grid.h"
#include "torch_api.h"

namespace gsf {
namespace {

constexpr int64_t kGrain = 8192;

struct Bounds {
  int32_t lo[3] = {INT32_MAX, INT32_MAX, INT32_MAX};
  int32_t hi[3] = {INT32_MIN, INT32_MIN, INT32_MIN};
  int64_t bad = 0;  // not finite, or so far away that node indices would not fit 32 bits
};

// Base node of every particle, and the bounds of all of them.
template <typename T>
Bounds find_bases(const T* position, int64_t n, double dx, int32_t* base) {
  constexpr int32_t kFar = int32_t(1) << 28;
  const NodeRange range{{-kFar, -kFar, -kFar}, {kFar, kFar, kFar}};
  const T inv_dx = T(1) / static_cast<T>(dx);
  const int64_t chunks = (n + kGrain - 1) / kGrain;
  std::vector<Bounds> bounds(std::max<int64_t>(chunks, 1));
  parallel_for(chunks, 1, [&](int64_t begin, int64_t end) {
    for (int64_t c = begin; c < end; ++c) {
      Bounds mine;
      for (int64_t p = c * kGrain; p < std::min(n, (c + 1) * kGrain); ++p) {
        Stencil<T> s;
        if (!make_stencil(position + 3 * p, inv_dx, range, s)) {
          ++mine.bad;
          continue;
        }
        for (int axis = 0; axis < 3; ++axis) {
          base[3 * p + axis] = s.base[axis];
          mine.lo[axis] = std::min(mine.lo[axis], s.base[axis]);
          mine.hi[axis] = std::max(mine.hi[axis], s.base[axis]);
        }
      }
      bounds[c] = mine;
    }
  });
  Bounds all;
  for (const Bounds& b : bounds) {
    all.bad += b.bad;
    for (int axis = 0; axis < 3; ++axis) {
      all.lo[axis] = std::min(all.lo[axis], b.lo[axis]);
      all.hi[axis] = std::max(all.hi[axis], b.hi[axis]);
    }
  }
  return all;
}

// Marks the blocks that the stencil of a particle reaches when it moves by at most `margin` nodes.
void mark(const int32_t* base, int64_t n, int32_t margin, const int32_t* origin,
          const int64_t* size, int32_t* table) {
  parallel_for(n, kGrain, [&](int64_t begin, int64_t end) {
    for (int64_t p = begin; p < end; ++p) {
      int64_t lo[3], hi[3];
      for (int axis = 0; axis < 3; ++axis) {
        lo[axis] = block_of(base[3 * p + axis] - margin) - origin[axis];
        hi[axis] = block_of(base[3 * p + axis] + 2 + margin) - origin[axis];
      }
      for (int64_t i = lo[0]; i <= hi[0]; ++i)
        for (int64_t j = lo[1]; j <= hi[1]; ++j)
          for (int64_t k = lo[2]; k <= hi[2]; ++k) {
            // Every thread stores the same value; reading first keeps the cache line shared.
            std::atomic_ref<int32_t> entry(table[(i * size[1] + j) * size[2] + k]);
            if (entry.load(std::memory_order_relaxed) != 0)
              entry.store(0, std::memory_order_relaxed);
          }
    }
  });
}

// info = origin x, y, z; particles that are not finite; table entries needed. When either of the
// last two says no, the other tensors are empty and the caller raises.
std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> build_blocks(Tensor position, double dx,
                                                                int64_t margin, int64_t max_table) {
  const char* op = "build_blocks";
  check_shape(op, "position", position, {-1, 3});
  STD_TORCH_CHECK(dx > 0, op, ": dx must be positive, got ", dx);
  STD_TORCH_CHECK(max_table >= 1 && max_table <= INT32_MAX / kBlockNodes, op,
                  ": max_table is out of range, got ", max_table);
  STD_TORCH_CHECK(margin >= 0 && margin <= 2, op, ": margin must be 0, 1 or 2, got ", margin);
  const Tensor x = gsf::contiguous(position);
  const int64_t n = x.size(0);
  STD_TORCH_CHECK(n < INT32_MAX, op, ": at most 2^31 - 1 particles");
  const Tensor info = new_zeros(x, {5}, ScalarType::Long);
  int64_t* facts = mptr<int64_t>(info);
  const Tensor base_tensor = new_empty(x, {n, 3}, ScalarType::Int);
  int32_t* base = mptr<int32_t>(base_tensor);
  const Bounds bounds =
      dispatch_floating(op, x, [&]<typename T>() { return find_bases(cptr<T>(x), n, dx, base); });

  int32_t origin[3] = {0, 0, 0};
  int64_t size[3] = {1, 1, 1};
  if (n > bounds.bad)
    for (int axis = 0; axis < 3; ++axis) {
      origin[axis] = block_of(bounds.lo[axis] - static_cast<int32_t>(margin));
      size[axis] = block_of(bounds.hi[axis] + 2 + static_cast<int32_t>(margin)) - origin[axis] + 1;
    }
  // Sizes stay below 2^28 each: the product of two fits, the third is compared by division.
  const int64_t plane = size[0] * size[1];
  const bool too_large = plane > max_table / size[2];
  for (int axis = 0; axis < 3; ++axis) facts[axis] = origin[axis];
  facts[3] = bounds.bad;
  facts[4] = too_large ? std::numeric_limits<int64_t>::max() : plane * size[2];
  if (bounds.bad > 0 || too_large) {
    const Tensor none = new_zeros(x, {0}, ScalarType::Int);
    return {new_zeros(x, {0, 0, 0}, ScalarType::Int), new_zeros(x, {0, 3}, ScalarType::Int), none,
            new_zeros(x, {1}, ScalarType::Int), info};
  }

  const Tensor table_tensor = new_empty(x, {size[0], size[1], size[2]}, ScalarType::Int);
  int32_t* table = mptr<int32_t>(table_tensor);
  const int64_t entries = plane * size[2];
  std::fill(table, table + entries, -1);
  mark(base, n, static_cast<int32_t>(margin), origin, size, table);
  std::vector<int32_t> found;
  for (int64_t e = 0; e < entries; ++e)
    if (table[e] == 0) {
      table[e] = static_cast<int32_t>(found.size() / 3);
      found.push_back(origin[0] + static_cast<int32_t>(e / (size[1] * size[2])));
      found.push_back(origin[1] + static_cast<int32_t>(e / size[2] % size[1]));
      found.push_back(origin[2] + static_cast<int32_t>(e % size[2]));
    }
  const int64_t count = static_cast<int64_t>(found.size() / 3);
  const Tensor coords = new_empty(x, {count, 3}, ScalarType::Int);
  std::copy(found.begin(), found.end(), mptr<int32_t>(coords));

  // Stable counting sort by (block, cell in block).
  std::vector<int32_t> offset(count * kBlockNodes + 1, 0);
  const auto key = [&](int64_t p) {
    const int32_t* b = base + 3 * p;
    const int64_t i = block_of(b[0]) - origin[0], j = block_of(b[1]) - origin[1],
                  k = block_of(b[2]) - origin[2];
    return int64_t(table[(i * size[1] + j) * size[2] + k]) * kBlockNodes +
           local_index(local_of(b[0]), local_of(b[1]), local_of(b[2]));
  };
  std::vector<int32_t> keys(n);
  parallel_for(n, kGrain, [&](int64_t begin, int64_t end) {
    for (int64_t p = begin; p < end; ++p) keys[p] = static_cast<int32_t>(key(p));
  });
  for (int64_t p = 0; p < n; ++p) ++offset[keys[p] + 1];
  for (int64_t i = 0; i < count * kBlockNodes; ++i) offset[i + 1] += offset[i];
  const Tensor start = new_empty(x, {count + 1}, ScalarType::Int);
  int32_t* first = mptr<int32_t>(start);
  for (int64_t b = 0; b <= count; ++b) first[b] = offset[b * kBlockNodes];
  const Tensor order = new_empty(x, {n}, ScalarType::Int);
  int32_t* rank = mptr<int32_t>(order);
  for (int64_t p = 0; p < n; ++p) rank[offset[keys[p]]++] = static_cast<int32_t>(p);
  return {table_tensor, coords, order, start, info};
}

}  // namespace
}  // namespace gsf

STABLE_TORCH_LIBRARY_IMPL(gsfluent, CPU, m) { GSF_IMPL(gsf, build_blocks); }
