// One scene on several ranks, in lockstep on one CPU: who holds what, and what they tell each other
// in a step (docs/theory/ranks.md).
//
// Points and homes of a rank are a stretch of those of all, in the order that a build gives them;
// slots, sites, node values and the clock are its own. Ranks that hold the same slot agree on its
// sums after each colour of homes: a node gets at most one addend from each, so its sum is taken in
// the same order as on one rank and has the same bits.
#pragma once

#include "cpu/solver/nodes.h"

namespace gsf::cpu {

template <typename T>
struct Rank {
  SolverView<T> view;
  std::vector<uint8_t> touched;  // [slots] Touched bits of this step
  // Of one rank of several; the only one holds what the view of all does.
  SolverClock clock;
  int64_t first_home = 0, homes = 0;
  RankSites sites;
  std::vector<int64_t> slots;  // [slots] numbers among those of all, ascending
  std::vector<int32_t> home_start, neighbour, slot_coord, slot_shared, site_slots;
  std::vector<double> sums;
  std::vector<T> moments, node_velocity;

  // The clock of all, with the rank's own blocks.
  void tell(const SolverClock& all) {
    clock = all;
    clock.homes = homes;
    clock.slots = static_cast<int64_t>(slots.size());
    clock.sites = static_cast<int64_t>(sites.number.size());
  }
};

template <typename T>
class RankCut {
 public:
  explicit RankCut(const SolverView<T>& s);

  // As many as the scene has; they stay where they are.
  std::vector<Rank<T>>& ranks() { return ranks_; }
  bool several() const { return ranks_.size() > 1; }

  // What each rank holds; again after each build.
  void make();
  // Before a step: each rank learns the time and the health of all.
  void begin();
  // After each colour of homes: all that hold a slot get what one of them added to it.
  void agree();
  // After the nodes of all ranks: what colliders got, which is booked in the order of all sites.
  void end_colliders(std::vector<Given>& given) const;

 private:
  using Word = std::conditional_t<sizeof(T) == 4, uint32_t, uint64_t>;
  struct Holder {
    int32_t rank, slot;
  };
  // A slot that several ranks hold.
  struct Halo {
    int64_t first, count;  // holders
  };

  void share_homes();
  void find_needed(const Rank<T>& rank);
  void fill(Rank<T>& rank);
  void find_halos();

  const SolverView<T>& s_;
  std::vector<Rank<T>> ranks_;
  std::vector<uint64_t> site_key_;     // [all sites] ascending
  std::vector<int32_t> site_of_slot_;  // [all slots]
  std::vector<uint8_t> held_;          // [all slots] kHeld, kNeeded of the rank at hand
  std::vector<uint8_t> answered_;      // [all sites] some rank answers for it
  std::vector<Halo> halos_;
  std::vector<Holder> holders_;
  std::vector<uint64_t> agreed_sums_;  // [halos, 64, 4] bits
  std::vector<Word> agreed_moments_;   // [halos, 64, kContactMoments] bits
};

}  // namespace gsf::cpu
