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

// Slots that several ranks hold.
struct Halos {
  struct Holder {
    int32_t rank, slot;
  };
  std::vector<int64_t> first{0};  // [halos + 1] of the holders of each
  std::vector<Holder> holders;

  int64_t count() const { return static_cast<int64_t>(first.size()) - 1; }
};

// Brings what ranks added to the slots that they share to all of them: after each colour of homes,
// in which at most one of them changed each value. So it does not matter in which order their bits
// meet, and an exclusive or of the changes finds them.
class Agreement {
 public:
  explicit Agreement(const Halos& halos) : halos_(halos) {}

  // Again after each build: the marks of each rank's slots,
  void plan(std::vector<uint8_t*> touched) {
    touched_ = std::move(touched);
    arrays_.clear();
  }
  // and arrays of theirs, which are there in slots with this mark and hold `bytes` of each node.
  void share(Touched mark, int64_t bytes, const std::vector<void*>& of_rank);
  // Before the first colour; all values are zero.
  void begin();
  void agree();

 private:
  struct Array {
    uint8_t mark;
    int64_t words;  // of each slot
    std::vector<unsigned char*> of_rank;
    std::vector<uint64_t> agreed;  // [halos, words]
  };
  void agree(Array& array, int64_t halo) const;

  const Halos& halos_;
  std::vector<uint8_t*> touched_;
  std::vector<Array> arrays_;
};

template <typename T>
class RankCut {
 public:
  explicit RankCut(const SolverView<T>& s) : s_(s), ranks_(s.ranks) {
    for (Rank<T>& rank : ranks_) rank.view = s;
  }

  // As many as the scene has; they stay where they are.
  std::vector<Rank<T>>& ranks() { return ranks_; }
  const Halos& halos() const { return halos_; }
  bool several() const { return ranks_.size() > 1; }

  // What each rank holds; again after each build.
  void make();
  // Before a step: each rank learns the time and the health of all.
  void begin();
  // After the nodes of all ranks: what colliders got, which is booked in the order of all sites.
  void end_colliders(std::vector<Given>& given) const;

 private:
  // The slot of all with this number, or -1 for what is none.
  int32_t slot(int32_t number) const { return number < s_.clock->slots ? number : -1; }
  // Whether the rank at hand needs one of the slots of a site.
  bool needed(const int32_t* slots) const;
  void share_homes();
  void find_held(const Rank<T>& rank);
  void fill(Rank<T>& rank);
  void find_halos();

  const SolverView<T>& s_;
  std::vector<Rank<T>> ranks_;
  std::vector<uint64_t> slot_key_;  // [all slots] ascending
  std::vector<uint8_t> held_;       // [all slots] Held, by the rank at hand
  std::vector<uint8_t> answered_;   // [all sites] some rank answers for it
  Halos halos_;
};

}  // namespace gsf::cpu
