// One scene on several ranks, in lockstep on one CPU: who holds what, and what they tell each other
// in a step (docs/theory/ranks.md).
//
// A rank has its points, node values, slots, sites and clock for itself; of the view of all it
// reads the lists of blocks, which every rank knows, and the tables of the scene. Ranks that hold
// the same slot agree on its sums after each colour of homes: a node gets at most one addend from
// each, so its sum is taken in the same order as on one rank and has the same bits.
#pragma once

#include "cpu/solver/nodes.h"

namespace gsf::cpu {

// Arrays of T with one row per point.
template <typename T>
struct PointArray {
  T* SolverView<T>::* array;
  int64_t columns;
};
template <typename T>
constexpr PointArray<T> kPointArrays[] = {
    {&SolverView<T>::offset, 3},      {&SolverView<T>::velocity, 3},
    {&SolverView<T>::slope, 9},       {&SolverView<T>::strain, 6},
    {&SolverView<T>::alpha, 1},       {&SolverView<T>::peak, 1},
    {&SolverView<T>::deformation, 9}, {&SolverView<T>::viscous, kViscousColumns},
    {&SolverView<T>::own, 9}};

// Points in memory of their own.
template <typename T>
struct RankPoints {
  int64_t count = 0;
  std::vector<T> rows[std::size(kPointArrays<T>)], spare;
  std::vector<uint32_t> meta;
  std::vector<int32_t> id, entry;

  // Room for so many, in the arrays that `like` has; at least one, so that no array looks absent.
  RankPoints(const SolverView<T>& like, int64_t points) : count(points) {
    const int64_t room = std::max<int64_t>(points, 1);
    for (size_t i = 0; i < std::size(rows); ++i)
      if (like.*kPointArrays<T>[i].array != nullptr)
        rows[i].resize(kPointArrays<T>[i].columns * room);
    spare.resize(9 * room);
    meta.resize(room);
    id.resize(room);
    entry.resize(room);
  }
  RankPoints() = default;

  void show(SolverView<T>& v) {
    for (size_t i = 0; i < std::size(rows); ++i)
      v.*kPointArrays<T>[i].array = rows[i].empty() ? nullptr : rows[i].data();
    v.count = count;
    v.spare = spare.data();
    v.meta = meta.data();
    v.id = id.data();
    v.entry = entry.data();
  }
};

// Copies points [p, p + count) to place `at` and on.
template <typename T>
void copy_points(const SolverView<T>& from, int64_t p, int64_t count, const SolverView<T>& to,
                 int64_t at) {
  for (const PointArray<T>& a : kPointArrays<T>)
    if (from.*a.array != nullptr)
      std::copy_n(from.*a.array + p * a.columns, count * a.columns, to.*a.array + at * a.columns);
  std::copy_n(from.meta + p, count, to.meta + at);
  std::copy_n(from.id + p, count, to.id + at);
}

template <typename T>
struct Rank {
  SolverView<T> view;
  std::vector<uint8_t> touched;  // [slots] Touched bits of this step
  // Of one rank of several; the only one holds what the view of all does.
  SolverClock clock;
  std::vector<int64_t> homes;  // numbers among those of all, ascending
  RankPoints<T> points;
  RankSites sites;
  std::vector<int64_t> slots;  // [slots] numbers among those of all, ascending
  std::vector<int32_t> home_coord, home_start, home_count, neighbour, slot_coord, slot_shared,
      site_slots;
  std::vector<double> sums;
  std::vector<T> moments, node_velocity;

  // The clock of all, with the rank's own blocks.
  void tell(const SolverClock& all) {
    clock = all;
    clock.homes = static_cast<int64_t>(homes.size());
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
  explicit RankCut(const SolverView<T>& s);
  // Puts the points back among those of all.
  void gather() const;

  // As many as the scene has; they stay where they are.
  std::vector<Rank<T>>& ranks() { return ranks_; }
  const Halos& halos() const { return halos_; }
  bool several() const { return ranks_.size() > 1; }

  // After a build of the lists of blocks: sends every point to the rank that owns its new home,
  // where it is grouped by home. home(rank, point, meta) = number of that home among all; it also
  // gives the point's meta word there.
  template <typename F>
  void send(const F& home);
  // What each rank holds; again after each build.
  void make();
  // Before a step: each rank learns the time and the health of all.
  void begin();
  // After the nodes of all ranks: what colliders got, which is booked in the order of all sites.
  void end_colliders(std::vector<Given>& given) const;

 private:
  // The slot of all with this number, or -1 for what is none.
  int32_t slot(int32_t number) const { return number < s_.clock->slots ? number : -1; }
  // Whether the rank at hand holds one of the slots of a site, or needs it.
  bool any(const int32_t* slots, uint8_t least) const;
  void share_homes();
  void own_homes(Rank<T>& rank);
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

template <typename T>
template <typename F>
void RankCut<T>::send(const F& home) {
  share_homes();
  const HomeList<T>& list = s_.homes();
  std::vector<RankPoints<T>> points;
  std::vector<SolverView<T>> views(ranks_.size(), s_);
  std::vector<int64_t> place(s_.clock->homes);  // of the next point of each home, in its rank
  std::vector<int32_t> owner(s_.clock->homes);
  for (size_t r = 0; r < ranks_.size(); ++r) {
    int64_t count = 0;
    for (const int64_t h : ranks_[r].homes) {
      place[h] = count;
      owner[h] = static_cast<int32_t>(r);
      count += list.count[h];
    }
    points.emplace_back(s_, count);
  }
  for (size_t r = 0; r < ranks_.size(); ++r) points[r].show(views[r]);
  for (size_t r = 0; r < ranks_.size(); ++r)
    for (int64_t p = 0; p < ranks_[r].points.count; ++p) {
      uint32_t meta;
      const int64_t h = home(r, p, meta);
      const SolverView<T>& to = views[owner[h]];
      copy_points(ranks_[r].view, p, 1, to, place[h]);
      to.meta[place[h]++] = meta;
    }
  for (size_t r = 0; r < ranks_.size(); ++r) {
    ranks_[r].points = std::move(points[r]);
    own_homes(ranks_[r]);
  }
}

// New homes and slots for the points of several ranks as they are, which go to the ranks that own
// them and are re-sorted there; or clock.grow or clock.reason of `s`, and nothing else changed.
template <typename T>
void solver_build(const SolverView<T>& s, RankCut<T>& cut);

}  // namespace gsf::cpu
