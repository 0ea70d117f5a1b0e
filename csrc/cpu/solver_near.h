// What contact reads around a node of the resident solver on the CPU.
#pragma once

#include <algorithm>
#include <vector>

#include "core/solver_node.h"

namespace gsf::cpu {

// Slots of the same field in the 27 blocks around every shared slot.
class SlotsAround {
 public:
  template <typename T>
  void find(const SolverView<T>& s) {
    const int64_t slots = s.clock->slots;
    row_.assign(slots, 0);
    slot_.clear();
    if (s.moments == nullptr) return;
    std::vector<uint64_t> keys(slots);  // ascending: see the builder
    for (int64_t b = 0; b < slots; ++b) keys[b] = key(s.slot_coord + 4 * b, 13);
    for (int64_t b = 0; b < slots; ++b) {
      if (s.slot_shared[b] != 1) continue;
      row_[b] = static_cast<int64_t>(slot_.size()) / kNeighbours;
      for (int n = 0; n < kNeighbours; ++n) {
        const uint64_t wanted = key(s.slot_coord + 4 * b, n);
        const auto at = std::lower_bound(keys.begin(), keys.end(), wanted);
        const bool found = at != keys.end() && *at == wanted;
        slot_.push_back(found ? static_cast<int32_t>(at - keys.begin()) : -1);
      }
    }
  }

  // In block n of the 27 around a shared slot; -1 when there is none.
  int32_t operator()(int32_t slot, int n) const { return slot_[kNeighbours * row_[slot] + n]; }

 private:
  static uint64_t key(const int32_t* c, int n) {
    return block_key(c[0] + n / 9 - 1, c[1] + n / 3 % 3 - 1, c[2] + n % 3 - 1, c[3]);
  }

  std::vector<int64_t> row_;   // [slots]
  std::vector<int32_t> slot_;  // [shared slots, 27]
};

// Sums around node `local` of the slots `slots` of a site, by field.
template <typename T>
struct SlotNear {
  const SolverView<T>& s;
  const SlotsAround& around;
  const int32_t* slots;
  int local;

  ContactSample<T> operator()(int field, int o) const {
    constexpr ContactSample<T> kNone{T(0), {T(0), T(0), T(0)}};
    int there;
    const int block = near_block(local, o, there);
    const int32_t slot = around(slots[field], block);
    if (slot < 0 || s.slot_shared[slot] == 0) return kNone;
    const int64_t n = int64_t(slot) * kBlockNodes + there;
    const T mass = static_cast<const T*>(s.sums)[4 * n + 3];
    if (!(mass > mass_floor<T>())) return kNone;
    const T* m = static_cast<const T*>(s.moments) + kContactMoments * n;
    return {mass, {m[0], m[1], m[2]}};
  }
};

}  // namespace gsf::cpu
