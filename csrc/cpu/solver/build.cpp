// Blocks of the resident solver on the CPU: finds the homes and slots the particles need, and
// brings the particles into their order. Everything is sorted by what it is (block, field, cell,
// state), never by where it lay before, so that the order in which particles were loaded leaves no
// trace in any sum.
#include <bit>
#include <cstring>
#include <type_traits>

#include "cpu/ranks/ranks.h"

namespace gsf::cpu {
namespace {

constexpr int64_t kGrain = 4096;

// Particles of one present home that now belong to one block.
struct Share {
  uint64_t key;
  int32_t from;   // present home
  int32_t local;  // which of the 27 blocks around it
};

// A home being made.
struct NewHome {
  uint64_t key;
  int64_t start = 0, count = 0;
  uint32_t reach = 0;
};

template <typename T>
class Builder {
 public:
  explicit Builder(const SolverView<T>& s) : s_(s), clock_(*s.clock) {}

  void run() {
    check_homes();
    if (!find_homes() || !find_slots()) return;
    sort_particles();
    move_particles();
    store();
  }

  // The same over several ranks. On each: what homes its points need. False when one has none.
  bool survey() {
    check_homes();
    return find_homes();
  }
  // Of all: their homes and slots; false, and nothing changed, when there is no room for them.
  bool join(const std::vector<Builder>& ranks) {
    for (const Builder& rank : ranks)
      next_.insert(next_.end(), rank.next_.begin(), rank.next_.end());
    std::stable_sort(next_.begin(), next_.end(),
                     [](const NewHome& a, const NewHome& b) { return a.key < b.key; });
    size_t homes = 0;
    for (const NewHome& home : next_) {
      if (homes == 0 || next_[homes - 1].key != home.key) {
        next_[homes++] = home;
        continue;
      }
      next_[homes - 1].count += home.count;
      next_[homes - 1].reach |= home.reach;
    }
    next_.resize(homes);
    int64_t at = 0;
    for (NewHome& home : next_) {
      home.start = at;
      at += home.count;
    }
    return find_slots();
  }
  // Of all: lists of blocks and clock.
  void store();
  uint64_t home_key(int64_t p) const { return next_[owner_[p]].key; }
  int64_t number(uint64_t key) const {
    return std::lower_bound(next_.begin(), next_.end(), key,
                            [](const NewHome& home, uint64_t k) { return home.key < k; }) -
           next_.begin();
  }
  // Meta word in the new home: l counts from there, cell of the block plus one.
  uint32_t new_meta(int64_t p) const {
    return pack_meta((cell(p, 0) & 3) + 1, (cell(p, 1) & 3) + 1, (cell(p, 2) & 3) + 1,
                     meta_row(s_.meta[p]));
  }
  // On each, with the points that it got: their order in their homes.
  void order() {
    survey();
    sort_particles();
    move_particles();
  }

 private:
  // The list of present homes, which must hold every particle once.
  void check_homes() {
    homes_ = clock_.homes;
    const HomeList<T>& list = s_.homes();
    bool sound = homes_ >= 0 && homes_ <= s_.home_capacity;
    owner_.assign(s_.count, -1);
    int64_t held = 0;
    for (int64_t h = 0; sound && h < homes_; ++h) {
      const int64_t start = list.start[h], count = list.count[h];
      const int32_t* c = list.coord + 4 * h;
      sound =
          start >= 0 && count >= 0 && start + count <= s_.count && c[3] >= 0 && c[3] < s_.fields;
      for (int axis = 0; axis < 3; ++axis)
        sound = sound && c[axis] >= -kBlockRange && c[axis] < kBlockRange;
      for (int64_t p = start; sound && p < start + count; ++p) {
        sound = owner_[p] < 0;
        owner_[p] = static_cast<int32_t>(h);
      }
      held += count;
    }
    STD_TORCH_CHECK(sound && held == s_.count,
                    "solver: the list of homes does not hold every particle once");
  }

  // Node of the grid that particle p's cell begins at, in cells of its present home's block.
  int cell(int64_t p, int axis) const {
    return std::min(meta_cell(s_.meta[p], axis), kLastCell) - 1;
  }
  int neighbour_of(int64_t p) const {  // 0..26
    int n = 0;
    for (int axis = 0; axis < 3; ++axis) n = 3 * n + (cell(p, axis) >> 2) + 1;
    return n;
  }
  int cell_of(int64_t p) const {
    return local_index(cell(p, 0) & 3, cell(p, 1) & 3, cell(p, 2) & 3);
  }

  // Homes in the order of their keys, with the particles of every cell counted.
  bool find_homes() {
    const HomeList<T>& list = s_.homes();
    std::vector<uint32_t> present(homes_, 0);
    std::vector<uint8_t> local(s_.count);
    for (int64_t p = 0; p < s_.count; ++p) {
      local[p] = static_cast<uint8_t>(neighbour_of(p));
      present[owner_[p]] |= 1u << local[p];
    }
    std::vector<Share> shares;
    for (int64_t h = 0; h < homes_; ++h)
      for (uint32_t left = present[h]; left != 0; left &= left - 1) {
        const int n = std::countr_zero(left);
        const int32_t* c = list.coord + 4 * h;
        const int32_t b[3] = {c[0] + n / 9 - 1, c[1] + n / 3 % 3 - 1, c[2] + n % 3 - 1};
        for (int axis = 0; axis < 3; ++axis)
          if (b[axis] <= -kBlockRange || b[axis] >= kBlockRange - 1) {
            clock_.reason = kOutside;
            return false;
          }
        shares.push_back({block_key(b[0], b[1], b[2], c[3]), static_cast<int32_t>(h), n});
      }
    std::sort(shares.begin(), shares.end(),
              [](const Share& a, const Share& b) { return a.key < b.key; });
    std::vector<int32_t> number(kNeighbours * homes_, 0);
    for (const Share& share : shares) {
      if (next_.empty() || next_.back().key != share.key) next_.push_back({share.key});
      number[kNeighbours * int64_t(share.from) + share.local] =
          static_cast<int32_t>(next_.size() - 1);
    }
    cells_.assign(next_.size() * kBlockNodes + 1, 0);
    for (int64_t p = 0; p < s_.count; ++p) {
      owner_[p] = number[kNeighbours * int64_t(owner_[p]) + local[p]];
      ++cells_[int64_t(owner_[p]) * kBlockNodes + cell_of(p)];
    }
    int64_t at = 0;
    for (size_t h = 0; h < next_.size(); ++h) {
      next_[h].start = at;
      for (int c = 0; c < kBlockNodes; ++c) {
        int32_t& entry = cells_[h * kBlockNodes + c];
        if (entry > 0) next_[h].reach |= reach_of(c >> 4, c >> 2 & 3, c & 3);
        const int32_t count = entry;
        entry = static_cast<int32_t>(at);
        at += count;
      }
      next_[h].count = at - next_[h].start;
    }
    cells_.back() = static_cast<int32_t>(at);
    return true;
  }

  // Slots of all blocks within reach, in the order of their keys, and their sites. False when there
  // is no room or too many fields meet.
  bool find_slots() {
    for (const NewHome& home : next_)
      for (int n = 0; n < kNeighbours; ++n)
        if (in_reach(home.reach, n)) slots_.push_back(neighbour_key(home.key, n));
    std::sort(slots_.begin(), slots_.end());
    slots_.erase(std::unique(slots_.begin(), slots_.end()), slots_.end());
    clock_.wanted_homes = static_cast<int64_t>(next_.size());
    clock_.wanted_slots = static_cast<int64_t>(slots_.size());
    if (clock_.wanted_homes > s_.home_capacity || clock_.wanted_slots > s_.slot_capacity) {
      clock_.grow = 1;
      return false;
    }
    for (size_t first = 0, end = 0; first < slots_.size(); first = end) {
      while (end < slots_.size() && slots_[end] >> kFieldBits == slots_[first] >> kFieldBits) ++end;
      if (end - first > size_t(kSiteFields)) {
        clock_.reason = kCrowded;
        return false;
      }
    }
    return true;
  }

  // Whether contact is possible between slots [first, end) of a site: not all move as one.
  bool parting(size_t first, size_t end) const {
    for (size_t a = first; a < end; ++a)
      for (size_t b = a + 1; b < end; ++b)
        if (!s_.moves_with(key_field(slots_[a]), key_field(slots_[b]))) return true;
    return false;
  }

  static uint64_t neighbour_key(uint64_t key, int n) {
    return block_key(key_block(key, 0) + n / 9 - 1, key_block(key, 1) + n / 3 % 3 - 1,
                     key_block(key, 2) + n % 3 - 1, key_field(key));
  }

  // Order of floats as bits: total, so that it is an order whatever the values.
  static bool before(const T* a, const T* b, int count, bool& equal) {
    using Word = std::conditional_t<sizeof(T) == 4, uint32_t, uint64_t>;
    for (int i = 0; i < count; ++i) {
      const Word x = std::bit_cast<Word>(a[i]), y = std::bit_cast<Word>(b[i]);
      if (x != y) {
        equal = false;
        return x < y;
      }
    }
    equal = true;
    return false;
  }
  // Order of two particles of one cell by their state. Particles equal in all of it may be swapped
  // without a trace.
  bool particle_before(int32_t a, int32_t b) const {
    bool equal;
    const auto differ = [&](const T* array, int width, bool& less) {
      if (array == nullptr) return false;
      less = before(array + int64_t(width) * a, array + int64_t(width) * b, width, equal);
      return !equal;
    };
    bool less = false;
    if (differ(s_.offset, 3, less)) return less;
    if (meta_row(s_.meta[a]) != meta_row(s_.meta[b]))
      return meta_row(s_.meta[a]) < meta_row(s_.meta[b]);
    if (differ(s_.velocity, 3, less) || differ(s_.slope, 9, less) || differ(s_.strain, 6, less) ||
        differ(s_.alpha, 1, less) || differ(s_.peak, 1, less) || differ(s_.deformation, 9, less) ||
        differ(s_.viscous, kViscousColumns, less) || differ(s_.own, 9, less))
      return less;
    return false;
  }

  // entry[place] = particle that belongs there.
  void sort_particles() {
    std::vector<int32_t> cursor(cells_.begin(), cells_.end() - 1);
    for (int64_t p = 0; p < s_.count; ++p)
      s_.entry[cursor[int64_t(owner_[p]) * kBlockNodes + cell_of(p)]++] = static_cast<int32_t>(p);
    parallel_for(static_cast<int64_t>(next_.size()), 8, [&](int64_t begin, int64_t end) {
      for (int64_t c = begin * kBlockNodes; c < end * kBlockNodes; ++c)
        std::sort(s_.entry + cells_[c], s_.entry + cells_[c + 1],
                  [this](int32_t a, int32_t b) { return particle_before(a, b); });
    });
  }

  template <typename Word>
  void move(Word* array, int width) {
    if (array == nullptr) return;
    Word* spare = reinterpret_cast<Word*>(s_.spare);
    parallel_for(s_.count, kGrain, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i)
        for (int c = 0; c < width; ++c)
          spare[width * i + c] = array[width * int64_t(s_.entry[i]) + c];
    });
    parallel_for(s_.count, kGrain, [&](int64_t begin, int64_t end) {
      std::memcpy(array + width * begin, spare + width * begin,
                  sizeof(Word) * width * (end - begin));
    });
  }

  void move_particles() {
    for (int64_t p = 0; p < s_.count; ++p) s_.meta[p] = new_meta(p);
    move(s_.offset, 3);
    move(s_.meta, 1);
    move(s_.velocity, 3);
    move(s_.slope, 9);
    move(s_.strain, 6);
    move(s_.alpha, 1);
    move(s_.peak, 1);
    move(s_.deformation, 9);
    move(s_.viscous, kViscousColumns);
    move(s_.own, 9);
    move(s_.id, 1);
  }

  const SolverView<T>& s_;
  SolverClock& clock_;
  int64_t homes_ = 0;
  std::vector<int32_t> owner_;  // home of each particle: present, then new
  std::vector<NewHome> next_;
  std::vector<int32_t> cells_;  // first place of every cell of every new home
  std::vector<uint64_t> slots_;
};

template <typename T>
void Builder<T>::store() {
  SolverView<T> s = s_;
  const HomeList<T>& list = s.next_homes();
  for (size_t h = 0; h < next_.size(); ++h) {
    for (int axis = 0; axis < 3; ++axis) list.coord[4 * h + axis] = key_block(next_[h].key, axis);
    list.coord[4 * h + 3] = key_field(next_[h].key);
    list.start[h] = static_cast<int32_t>(next_[h].start);
    list.count[h] = static_cast<int32_t>(next_[h].count);
  }
  // Keys of one neighbour grow with the keys of the homes: one walk per neighbour.
  for (int n = 0; n < kNeighbours; ++n) {
    size_t slot = 0;
    for (size_t h = 0; h < next_.size(); ++h) {
      int32_t& entry = s.neighbour[kNeighbours * h + n];
      entry = -1;
      if (!in_reach(next_[h].reach, n)) continue;
      const uint64_t key = neighbour_key(next_[h].key, n);
      while (slots_[slot] != key) ++slot;
      entry = static_cast<int32_t>(slot);
    }
  }
  clock_.sites = clock_.shared_sites = 0;
  for (size_t first = 0, end = 0; first < slots_.size(); first = end) {
    while (end < slots_.size() && slots_[end] >> kFieldBits == slots_[first] >> kFieldBits) ++end;
    int32_t* site = s.site_slots + kSiteFields * clock_.sites;
    const int parts = parting(first, end) ? 1 : 0;
    for (int i = 0; i < kSiteFields; ++i)
      site[i] = first + i < end ? static_cast<int32_t>(first + i) : -1;
    for (size_t slot = first; slot < end; ++slot) {
      for (int axis = 0; axis < 3; ++axis)
        s.slot_coord[4 * slot + axis] = key_block(slots_[slot], axis);
      s.slot_coord[4 * slot + 3] = key_field(slots_[slot]);
      s.slot_shared[slot] = parts;
    }
    clock_.sites += 1;
    clock_.shared_sites += parts;
  }
  clock_.homes = static_cast<int64_t>(next_.size());
  clock_.slots = static_cast<int64_t>(slots_.size());
  clock_.homes_max = std::max(clock_.homes_max, clock_.homes);
  clock_.slots_max = std::max(clock_.slots_max, clock_.slots);
  clock_.parity = 1 - (clock_.parity & 1);
  clock_.rebuild = 0;
  clock_.builds += 1;
}

}  // namespace

template <typename T>
void solver_build(const SolverView<T>& s) {
  Builder<T>(s).run();
}

template <typename T>
void solver_build(const SolverView<T>& s, RankCut<T>& cut) {
  std::vector<Builder<T>> ranks;
  for (const Rank<T>& rank : cut.ranks()) {
    if (ranks.emplace_back(rank.view).survey()) continue;
    s.clock->reason = rank.clock.reason;
    return;
  }
  Builder<T> all(s);
  if (!all.join(ranks)) return;
  all.store();
  cut.send([&](size_t r, int64_t p, uint32_t& meta) {
    meta = ranks[r].new_meta(p);
    return all.number(ranks[r].home_key(p));
  });
  for (const Rank<T>& rank : cut.ranks()) Builder<T>(rank.view).order();
}

template void solver_build<float>(const SolverView<float>&);
template void solver_build<double>(const SolverView<double>&);
template void solver_build(const SolverView<float>&, RankCut<float>&);
template void solver_build(const SolverView<double>&, RankCut<double>&);

}  // namespace gsf::cpu
