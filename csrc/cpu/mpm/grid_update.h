// CPU kernel of grid_update: chunks of blocks in parallel, sums over chunks in their order.
#pragma once

#include <algorithm>
#include <numeric>
#include <vector>

#include "core/mpm/args.h"
#include "torch_api.h"

namespace gsf {
namespace cpu {

// Ordered sums over chunks of `columns` numbers: the same for any number of threads.
inline void sum_chunks(const double* partial, int64_t chunks, int64_t columns, double* sums) {
  for (int64_t chunk = 0; chunk < chunks; ++chunk)
    for (int64_t i = 0; i < columns; ++i) sums[i] += partial[chunk * columns + i];
}

template <typename T>
void grid_update(const GridUpdateArgs<T>& a) {
  const int64_t chunks = grid_update_chunks(a.count), rows = a.collider_count;
  std::vector<int64_t> touched(chunks, 0);
  std::vector<char> valid(rows, 0);
  bool any_mass = false;
  for (int64_t c = 0; c < rows; ++c) {
    const T* row = a.colliders + c * kColliderColumns;
    valid[c] = collider_valid(row, a.sdf_count);
    any_mass = any_mass || (valid[c] && row[kMass] > T(0));
    // A row that is no collider must not be ignored quietly.
    if (!valid[c]) std::fill(a.impulse + 6 * c, a.impulse + 6 * c + 6, double(NAN));
  }
  // Nodes of a chunk; with a collider only of blocks it may reach.
  const auto for_nodes = [&](int64_t chunk, const T* row, const auto& f) {
    const int64_t last = std::min((chunk + 1) * kChunkBlocks, a.count);
    for (int64_t block = chunk * kChunkBlocks; block < last; ++block) {
      if (row != nullptr && block_clear(a, row, block)) continue;
      for (int64_t n = 0; n < kBlockNodes; ++n) f(block * kBlockNodes + n);
    }
  };
  const T* no_collider = nullptr;
  parallel_for(chunks, 1, [&](int64_t begin, int64_t end) {
    for (int64_t chunk = begin; chunk < end; ++chunk) {
      for_nodes(chunk, no_collider, [&](int64_t node) { touched[chunk] += update_node(a, node); });
      double* mass = a.partial + chunk * rows;
      for (int64_t c = 0; any_mass && c < rows; ++c) {
        const T* row = a.colliders + c * kColliderColumns;
        mass[c] = 0.0;
        if (!valid[c] || !(row[kMass] > T(0))) continue;
        for_nodes(chunk, row, [&](int64_t node) { mass[c] += touching_mass(a, row, node); });
      }
    }
  });
  if (any_mass) sum_chunks(a.partial, chunks, rows, a.contact_mass);
  if (rows > 0) {
    parallel_for(chunks, 1, [&](int64_t begin, int64_t end) {
      for (int64_t chunk = begin; chunk < end; ++chunk) {
        double* partial = a.partial + 6 * chunk * rows;
        std::fill(partial, partial + 6 * rows, 0.0);
        for (int64_t c = 0; c < rows; ++c) {
          const T* row = a.colliders + c * kColliderColumns;
          if (!valid[c]) continue;
          const T give = collider_give(row, static_cast<T>(a.contact_mass[c]));
          for_nodes(chunk, row,
                    [&](int64_t node) { collide_node(a, row, give, node, partial + 6 * c); });
        }
      }
    });
    sum_chunks(a.partial, chunks, 6 * rows, a.impulse);
  }
  *a.contact_nodes = std::accumulate(touched.begin(), touched.end(), int64_t(0));
}

}  // namespace cpu
}  // namespace gsf
