// See cpu/ranks/ranks.h. A file of its own, so that the loops of one rank stay as they are
// compiled.
#include "cpu/ranks/ranks.h"

#include <cstring>

namespace gsf::cpu {
namespace {

constexpr int64_t kHaloGrain = 16;
enum Held : uint8_t { kHeld = 1, kNeeded = 2 };

}  // namespace

void Agreement::share(Touched mark, int64_t bytes, const std::vector<void*>& of_rank) {
  if (std::all_of(of_rank.begin(), of_rank.end(), [](void* p) { return p == nullptr; })) return;
  Array& array = arrays_.emplace_back();
  array.mark = mark;
  array.words = kBlockNodes * bytes / int64_t(sizeof(uint64_t));
  for (void* p : of_rank) array.of_rank.push_back(static_cast<unsigned char*>(p));
  array.agreed.resize(halos_.count() * array.words);
}

void Agreement::begin() {
  for (Array& array : arrays_) std::fill(array.agreed.begin(), array.agreed.end(), 0);
}

void Agreement::agree() {
  parallel_for(halos_.count(), kHaloGrain, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      uint8_t marks = 0;
      for (int64_t at = halos_.first[i]; at < halos_.first[i + 1]; ++at)
        marks |= touched_[halos_.holders[at].rank][halos_.holders[at].slot];
      for (int64_t at = halos_.first[i]; at < halos_.first[i + 1]; ++at)
        touched_[halos_.holders[at].rank][halos_.holders[at].slot] = marks;
      for (Array& array : arrays_)
        if (marks & array.mark) agree(array, i);
    }
  });
}

void Agreement::agree(Array& array, int64_t halo) const {
  uint64_t* agreed = array.agreed.data() + halo * array.words;
  const auto holder = halos_.holders.begin();
  const auto copy = [&](int64_t at) {
    return array.of_rank[holder[at].rank] + holder[at].slot * array.words * sizeof(uint64_t);
  };
  const int64_t first = halos_.first[halo], end = halos_.first[halo + 1];
  for (int64_t i = 0; i < array.words; ++i) {
    uint64_t changed = 0, bits;
    for (int64_t at = first; at < end; ++at) {
      std::memcpy(&bits, copy(at) + i * sizeof bits, sizeof bits);
      changed ^= bits ^ agreed[i];
    }
    if (changed == 0) continue;
    agreed[i] ^= changed;
    for (int64_t at = first; at < end; ++at)
      std::memcpy(copy(at) + i * sizeof bits, agreed + i, sizeof bits);
  }
}

template <typename T>
RankCut<T>::RankCut(const SolverView<T>& s) : s_(s), ranks_(s.ranks) {
  if (!several()) {
    ranks_[0].view = s;
    return;
  }
  const HomeList<T>& list = s.homes();
  int64_t held = 0;
  bool sound = s.clock->homes >= 0 && s.clock->homes <= s.home_capacity;
  for (int64_t h = 0; sound && h < s.clock->homes; ++h) {
    sound = list.start[h] == held && list.count[h] >= 0 && list.count[h] <= s.count - held;
    held += list.count[h];
  }
  STD_TORCH_CHECK(sound && held == s.count,
                  "solver: several ranks need the points in the order of their homes");
  share_homes();
  for (Rank<T>& rank : ranks_) {
    int64_t count = 0;
    for (const int64_t h : rank.homes) count += list.count[h];
    rank.points = RankPoints<T>(s, count);
    own_homes(rank);
    for (size_t i = 0; i < rank.homes.size(); ++i)
      copy_points(s, list.start[rank.homes[i]], rank.home_count[i], rank.view, rank.home_start[i]);
  }
}

template <typename T>
void RankCut<T>::gather() const {
  if (!several()) return;
  for (const Rank<T>& rank : ranks_)
    for (size_t i = 0; i < rank.homes.size(); ++i)
      copy_points(rank.view, rank.home_start[i], rank.home_count[i], s_,
                  s_.homes().start[rank.homes[i]]);
}

template <typename T>
void RankCut<T>::make() {
  const SolverClock& c = *s_.clock;
  if (!several()) {
    ranks_[0].touched.assign(c.slots, 0);
    return;
  }
  slot_key_.resize(c.slots);
  for (int64_t i = 0; i < c.slots; ++i) {
    const int32_t* b = s_.slot_coord + 4 * i;
    slot_key_[i] = block_key(b[0], b[1], b[2], b[3]);
  }
  answered_.assign(c.sites, 0);
  share_homes();
  for (Rank<T>& rank : ranks_) {
    find_held(rank);
    fill(rank);
  }
  find_halos();
}

// Cuts across the longest axis, with about as many points on each side as there are ranks to come.
template <typename T>
void RankCut<T>::share_homes() {
  const HomeList<T>& list = s_.homes();
  const int64_t homes = s_.clock->homes, ranks = static_cast<int64_t>(ranks_.size());
  int axis = 0;
  int32_t longest = -1;
  for (int a = 0; a < 3; ++a) {
    int32_t low = kBlockRange, high = -kBlockRange;
    for (int64_t h = 0; h < homes; ++h) {
      low = std::min(low, list.coord[4 * h + a]);
      high = std::max(high, list.coord[4 * h + a]);
    }
    if (high - low > longest) {
      longest = high - low;
      axis = a;
    }
  }
  std::vector<int64_t> along(homes);
  std::iota(along.begin(), along.end(), 0);
  std::stable_sort(along.begin(), along.end(), [&](int64_t a, int64_t b) {
    return list.coord[4 * a + axis] < list.coord[4 * b + axis];
  });
  for (Rank<T>& rank : ranks_) rank.homes.clear();
  int64_t r = 0, before = 0;
  for (const int64_t h : along) {
    while (r + 1 < ranks && before >= (r + 1) * s_.count / ranks) ++r;
    ranks_[r].homes.push_back(h);
    before += list.count[h];
  }
  for (Rank<T>& rank : ranks_) std::sort(rank.homes.begin(), rank.homes.end());
}

template <typename T>
bool RankCut<T>::any(const int32_t* slots, uint8_t least) const {
  return std::any_of(slots, slots + kSiteFields,
                     [&](int32_t i) { return slot(i) >= 0 && held_[slot(i)] >= least; });
}

// Slots under the windows of a rank's homes, which it needs. Where fields may meet it also holds
// what its share of contact hangs on, whoever needs it: every field at the sites of what it needs,
// the nodes around those that fields share, and whether a block next to its homes is shared.
template <typename T>
void RankCut<T>::find_held(const Rank<T>& rank) {
  held_.assign(s_.clock->slots, 0);
  const auto hold = [&](int64_t i) { held_[i] = std::max<uint8_t>(held_[i], kHeld); };
  for (const int64_t h : rank.homes)
    for (int n = 0; n < kNeighbours; ++n) {
      const int32_t below = slot(s_.neighbour[kNeighbours * h + n]);
      if (below >= 0) held_[below] = kNeeded;
    }
  if (s_.fields == 1) return;
  const auto around = [&](const int32_t* b, const auto& f) {
    for (int n = 0; n < kNeighbours; ++n) {
      const uint64_t key =
          block_key(b[0] + n / 9 - 1, b[1] + n / 3 % 3 - 1, b[2] + n % 3 - 1, b[3]);
      const auto at = std::lower_bound(slot_key_.begin(), slot_key_.end(), key);
      if (at != slot_key_.end() && *at == key) f(at - slot_key_.begin());
    }
  };
  for (const int64_t h : rank.homes)
    around(s_.homes().coord + 4 * h, [&](int64_t i) {
      if (s_.slot_shared[i] != 0) hold(i);
    });
  if (s_.object != nullptr)
    for (const int64_t h : rank.homes)
      for (int n = 0; n < kNeighbours; ++n) {
        const int32_t* b = s_.homes().coord + 4 * h;
        const auto key = [&](int field) {
          return block_key(b[0] + n / 9 - 1, b[1] + n / 3 % 3 - 1, b[2] + n % 3 - 1, field);
        };
        auto at = std::lower_bound(slot_key_.begin(), slot_key_.end(), key(0));
        for (; at != slot_key_.end() && *at < key(kMaxSolverFields); ++at)
          hold(at - slot_key_.begin());
      }
  for (int64_t i = 0; i < s_.clock->sites; ++i) {
    const int32_t* slots = s_.site_slots + kSiteFields * i;
    if (!any(slots, kNeeded)) continue;
    for (int f = 0; f < kSiteFields; ++f) {
      const int32_t here = slot(slots[f]);
      if (here < 0) continue;
      hold(here);
      if (s_.slot_shared[here] != 0) around(s_.slot_coord + 4 * int64_t(here), hold);
    }
  }
}

// The rank's view of its points and homes.
template <typename T>
void RankCut<T>::own_homes(Rank<T>& rank) {
  const HomeList<T>& list = s_.homes();
  rank.home_coord.clear();
  rank.home_start.clear();
  rank.home_count.clear();
  int32_t at = 0;
  for (const int64_t h : rank.homes) {
    rank.home_coord.insert(rank.home_coord.end(), list.coord + 4 * h, list.coord + 4 * h + 4);
    rank.home_start.push_back(at);
    rank.home_count.push_back(list.count[h]);
    at += list.count[h];
  }
  rank.view = s_;
  rank.points.show(rank.view);
  rank.view.clock = &rank.clock;
  rank.view.home_capacity = static_cast<int64_t>(rank.homes.size());
  rank.view.home[0] =
      rank.view.home[1] = {rank.home_coord.data(), rank.home_start.data(), rank.home_count.data()};
  rank.tell(*s_.clock);
}

// The rank's own lists of what find_held found, and its view.
template <typename T>
void RankCut<T>::fill(Rank<T>& rank) {
  own_homes(rank);
  std::vector<int32_t> number(s_.clock->slots, -1);
  rank.slots.clear();
  rank.slot_coord.clear();
  rank.slot_shared.clear();
  for (int64_t i = 0; i < s_.clock->slots; ++i) {
    if (held_[i] == 0) continue;
    number[i] = static_cast<int32_t>(rank.slots.size());
    rank.slots.push_back(i);
    rank.slot_coord.insert(rank.slot_coord.end(), s_.slot_coord + 4 * i, s_.slot_coord + 4 * i + 4);
    rank.slot_shared.push_back(s_.slot_shared[i]);
  }
  const auto own = [&](int32_t of_all) { return slot(of_all) >= 0 ? number[of_all] : -1; };
  rank.sites = {};
  rank.site_slots.clear();
  for (int64_t i = 0; i < s_.clock->sites; ++i) {
    const int32_t* slots = s_.site_slots + kSiteFields * i;
    const bool answers = any(slots, kNeeded) && answered_[i] == 0;
    // Points look for each other at the sites around them, too.
    if (!any(slots, s_.object != nullptr ? kHeld : kNeeded)) continue;
    rank.sites.number.push_back(i);
    rank.sites.answers.push_back(answers ? 1 : 0);
    if (answers) answered_[i] = 1;
    for (int f = 0; f < kSiteFields; ++f) rank.site_slots.push_back(own(slots[f]));
  }
  rank.neighbour.clear();
  for (const int64_t h : rank.homes)
    for (int n = 0; n < kNeighbours; ++n)
      rank.neighbour.push_back(own(s_.neighbour[kNeighbours * h + n]));
  const int64_t nodes = static_cast<int64_t>(rank.slots.size()) * kBlockNodes;
  rank.touched.assign(rank.slots.size(), 0);
  rank.sums.assign(4 * nodes, 0.0);
  rank.moments.assign(s_.moments != nullptr ? kContactMoments * nodes : 0, T(0));
  rank.node_velocity.assign(4 * nodes, T(0));

  SolverView<T>& v = rank.view;
  v.slot_capacity = static_cast<int64_t>(rank.slots.size());
  v.neighbour = rank.neighbour.data();
  v.slot_coord = rank.slot_coord.data();
  v.slot_shared = rank.slot_shared.data();
  v.site_slots = rank.site_slots.data();
  v.sums = rank.sums.data();
  v.moments = rank.moments.empty() ? nullptr : rank.moments.data();
  v.node_velocity = rank.node_velocity.data();
  rank.tell(*s_.clock);
}

template <typename T>
void RankCut<T>::find_halos() {
  std::vector<std::vector<Halos::Holder>> holders(s_.clock->slots);
  for (size_t r = 0; r < ranks_.size(); ++r)
    for (size_t i = 0; i < ranks_[r].slots.size(); ++i)
      holders[ranks_[r].slots[i]].push_back({static_cast<int32_t>(r), static_cast<int32_t>(i)});
  halos_.first.assign(1, 0);
  halos_.holders.clear();
  for (const std::vector<Halos::Holder>& of_slot : holders) {
    if (of_slot.size() < 2) continue;
    halos_.holders.insert(halos_.holders.end(), of_slot.begin(), of_slot.end());
    halos_.first.push_back(static_cast<int64_t>(halos_.holders.size()));
  }
}

template <typename T>
void RankCut<T>::begin() {
  if (!several()) return;
  for (Rank<T>& rank : ranks_) rank.tell(*s_.clock);
}

template <typename T>
void RankCut<T>::end_colliders(std::vector<Given>& given) const {
  std::stable_sort(given.begin(), given.end(),
                   [](const Given& a, const Given& b) { return a.site < b.site; });
  std::vector<double> sums(s_.collider_count * kImpulseSums, 0.0), chunk(sums.size(), 0.0);
  const auto close = [&] {
    for (size_t i = 0; i < sums.size(); ++i) sums[i] += chunk[i];
    std::fill(chunk.begin(), chunk.end(), 0.0);
  };
  for (size_t i = 0; i < given.size(); ++i) {
    if (i > 0 && given[i].site / kSiteChunk != given[i - 1].site / kSiteChunk) close();
    for (int n = 0; n < kImpulseSums; ++n)
      chunk[given[i].collider * kImpulseSums + n] += given[i].sums[n];
  }
  close();
  for (int64_t k = 0; k < s_.collider_count; ++k)
    end_collider(s_, k, sums.data() + k * kImpulseSums, s_.clock->dt);
}

template class RankCut<float>;
template class RankCut<double>;

}  // namespace gsf::cpu
