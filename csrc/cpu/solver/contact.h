// Where the velocity fields of the resident solver meet: which nodes need moments, and how a node
// finds those of its neighbours.
#pragma once

#include "core/mpm/contact.h"
#include "cpu/solver/solver.h"

namespace gsf::cpu {

// Neighbour o of node `local` of a block: which of the 27 blocks around it holds it, and where.
struct NearTable {
  uint8_t block[kBlockNodes][27], at[kBlockNodes][27];
  constexpr NearTable() : block{}, at{} {
    for (int local = 0; local < kBlockNodes; ++local)
      for (int o = 0; o < 27; ++o) {
        const int step[3] = {o / 9 - 1, o / 3 % 3 - 1, o % 3 - 1};
        int b = 0, n = 0;
        for (int axis = 0; axis < 3; ++axis) {
          const int node = (local >> (4 - 2 * axis) & 3) + step[axis];
          b = 3 * b + (node >> 2) + 1;
          n = 4 * n + (node & 3);
        }
        block[local][o] = static_cast<uint8_t>(b);
        at[local][o] = static_cast<uint8_t>(n);
      }
  }
};
constexpr NearTable kNear;

template <typename T>
class ContactPlan {
 public:
  explicit ContactPlan(const SolverView<T>& s) : s_(s) {}

  // Where fields meet: the slots of a field around each of its shared ones, and for each home which
  // of the 27 blocks around it are shared by its field. Slots lie in the order of their keys.
  void make() {
    const SolverClock& c = *s_.clock;
    row_.assign(s_.moments != nullptr && c.shared_sites > 0 ? c.slots : 0, -1);
    around_.clear();
    home_.assign(row_.empty() ? 0 : c.homes, 0);
    if (row_.empty()) return;
    const auto key = [&](const int32_t* b) { return block_key(b[0], b[1], b[2], b[3]); };
    keys_.resize(c.slots);
    for (int64_t i = 0; i < c.slots; ++i) keys_[i] = key(s_.slot_coord + 4 * i);
    const auto around = [&](const int32_t* b, int n) {
      return slot(block_key(b[0] + n / 9 - 1, b[1] + n / 3 % 3 - 1, b[2] + n % 3 - 1, b[3]));
    };
    for (int64_t i = 0; i < c.slots; ++i) {
      if (s_.slot_shared[i] == 0) continue;
      row_[i] = static_cast<int32_t>(around_.size() / kNeighbours);
      for (int n = 0; n < kNeighbours; ++n) around_.push_back(around(s_.slot_coord + 4 * i, n));
    }
    for (int64_t h = 0; h < c.homes; ++h)
      for (int n = 0; n < kNeighbours; ++n) {
        const int32_t b = around(s_.homes().coord + 4 * h, n);
        if (b >= 0 && s_.slot_shared[b] != 0) home_[h] |= 1u << n;
      }
  }

  // False when nowhere two fields share a block.
  bool any() const { return !row_.empty(); }
  // Shared ones of the 27 blocks around home h, as bits.
  uint32_t around_home(int64_t h) const { return any() ? home_[h] : 0; }

  // Slot of a block of a field, or -1; where any() holds.
  int32_t slot(uint64_t key) const {
    const auto at = std::lower_bound(keys_.begin(), keys_.end(), key);
    return at != keys_.end() && *at == key ? static_cast<int32_t>(at - keys_.begin()) : -1;
  }

  // Cells whose stencil has nodes in one of these blocks or next to it, which are read where fields
  // meet: bit 4 i + 2 j + k for the halves i, j, k of the block, the upper ones from cell 2 on.
  static uint32_t readers(uint32_t blocks) {
    uint32_t cells = 0;
    for (; blocks != 0; blocks &= blocks - 1) {
      const int n = __builtin_ctz(blocks);
      const int step[3] = {n / 9, n / 3 % 3, n % 3};
      for (int half = 0; half < 8; ++half) {
        bool meets = true;
        for (int axis = 0; axis < 3; ++axis)
          meets = meets && (step[axis] == 1 || (half >> (2 - axis) & 1) == step[axis] / 2);
        if (meets) cells |= 1u << half;
      }
    }
    return cells;
  }
  // Whether the cell of this word is one of readers(blocks).
  static bool reads(uint32_t readers, uint32_t meta) {
    int half = 0;
    for (int axis = 0; axis < 3; ++axis) half = 2 * half + (meta_cell(meta, axis) >= 2 ? 1 : 0);
    return (readers >> half & 1u) != 0;
  }

  // Mass and moment of a field at a neighbour of node `local`, for core/mpm/contact.h.
  ContactSample<T> sample(int32_t slot, int local, int o) const {
    const int32_t row = row_[slot];
    if (row < 0) return {T(0), {T(0), T(0), T(0)}};
    const int32_t other = around_[int64_t(row) * kNeighbours + kNear.block[local][o]];
    if (other < 0) return {T(0), {T(0), T(0), T(0)}};
    const int64_t n = int64_t(other) * kBlockNodes + kNear.at[local][o];
    const T* m = static_cast<const T*>(s_.moments) + kContactMoments * n;
    return {T(static_cast<const double*>(s_.sums)[4 * n + 3]), {m[0], m[1], m[2]}};
  }

 private:
  const SolverView<T>& s_;
  std::vector<uint64_t> keys_;   // [slots]
  std::vector<int32_t> row_;     // [slots] row in around_, or -1; empty when no site is shared
  std::vector<int32_t> around_;  // [shared slots, 27] slots of the same field
  std::vector<uint32_t> home_;   // [homes]
};

}  // namespace gsf::cpu
