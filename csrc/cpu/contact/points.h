// Points of the resident solver that points of other bodies push: core/collider/touch.h.
#pragma once

#include <bit>
#include <numeric>

#include "core/solver/points.h"
#include "cpu/solver/contact.h"
#include "cpu/solver/surface.h"

namespace gsf::cpu {

// Where the cells of a home lie, by the nine bits of a meta word: which of the 27 blocks around it,
// which cell of that, and which bit of ContactPlan::readers.
struct CellPlaces {
  uint8_t block[512], local[512], half[512];
  bool used[512];  // by a whole word
  constexpr CellPlaces() : block{}, local{}, half{}, used{} {
    for (uint32_t word = 0; word < 512; ++word) {
      int b = 0, n = 0, h = 0;
      used[word] = true;
      for (int axis = 0; axis < 3; ++axis) {
        const int l = static_cast<int>(word >> (3 * axis) & 7u);
        const int cell = (l < kLastCell ? l : kLastCell) - 1;
        used[word] = used[word] && l <= kLastCell;
        b = 3 * b + (cell >> 2) + 1;
        n = 4 * n + (cell & 3);
        h = 2 * h + (l >= 2 ? 1 : 0);
      }
      block[word] = static_cast<uint8_t>(b);
      local[word] = static_cast<uint8_t>(n);
      half[word] = static_cast<uint8_t>(h);
    }
  }
};
constexpr CellPlaces kPlaceOf;

// The cells of a block that lie beside cells of another, as bits: f(block, cells) for each of the
// 27 blocks around it that has any.
template <typename F>
void each_beside(uint64_t cells, const F& f) {
  // Along an axis of this stride: a step down, none and a step up.
  const auto spread = [](uint64_t in, int stride, uint64_t first, uint64_t* out) {
    const uint64_t last = first << (3 * stride);
    out[0] = (in & first) << (3 * stride);
    out[1] = in | (in & ~first) >> stride | (in & ~last) << stride;
    out[2] = (in & last) >> (3 * stride);
  };
  uint64_t x[3], y[3], z[3];
  spread(cells, 16, 0xffffull, x);
  for (int i = 0; i < 3; ++i) {
    if (x[i] == 0) continue;
    spread(x[i], 4, 0x000f000f000f000full, y);
    for (int j = 0; j < 3; ++j) {
      if (y[j] == 0) continue;
      spread(y[j], 1, 0x1111111111111111ull, z);
      for (int k = 0; k < 3; ++k)
        if (z[k] != 0) f((3 * i + j) * 3 + k, z[k]);
    }
  }
}

template <typename T>
class TouchPlan {
 public:
  TouchPlan(const SolverView<T>& s, const ContactPlan<T>& contact) : s_(s), contact_(contact) {}

  // Tables of the blocks; again after each build.
  void make() {
    const SolverClock& c = *s_.clock;
    cells_.clear();  // of slots that may be gone
    items_.clear();
    on_ = several() && s_.radius != nullptr && contact_.any();
    if (!on_) return;
    const double step = spring_step(s_);
    rows_.resize(s_.row_count);
    for (int64_t row = 0; row < s_.row_count; ++row)
      rows_[row] = {touch_matter(s_, row, step), spring_lag(row_wave(s_, row), double(s_.dx))};
    near_.assign(c.slots, 0);
    first_.assign(c.slots * kBlockNodes, -1);
    push_.assign(c.slots * kBlockNodes * 4, T(0));
    given_.assign(4 * s_.count, T(0));
    homes_.assign(c.homes, 0);
    site_.assign(c.slots, -1);
    key_.resize(c.sites);
    around_.assign(c.sites * kNeighbours, -2);
    for (int64_t i = 0; i < c.sites; ++i) {
      const int32_t* slots = s_.site_slots + kSiteFields * i;
      const int32_t* b = s_.slot_coord + 4 * int64_t(slots[0]);
      key_[i] = block_key(b[0], b[1], b[2], 0);
      for (int f = 0; f < kSiteFields && slots[f] >= 0; ++f)
        site_[slots[f]] = static_cast<int32_t>(i);
    }
  }

  bool any() const { return on_; }
  // Whether a point of home h is pushed in this step.
  bool pushes(int64_t h) const { return on_ && homes_[h] != 0; }
  // What point p gets, [4]: impulse and its length [N s].
  const T* given(int64_t p) const { return given_.data() + 4 * p; }
  // Sums of these over the points about each node: [slots, 64, 4].
  T* sums() { return push_.data(); }
  const T* sums() const { return push_.data(); }

  // A point that could touch another body.
  struct Item {
    int32_t point, home;        // home: -1 for points of another rank
    int32_t first_near, nears;  // those of other bodies within reach, in `nears` of its chunk
    bool pushed;
    double x[3], v[3];  // place in cells and velocity in cells per second
    TouchMatter matter;
    double share;   // of other bodies at which it touches
    double lag;     // time of the damping [s]
    double kept;    // share of a push that is left while bodies part
    double energy;  // V dE/df [Pa cells]
  };
  // One on its way to the other ranks.
  struct Offer {
    int64_t home;   // its home among those of all
    uint64_t slot;  // key of the block and field that it is in
    int32_t rank, local;
    Item item;
  };

  // What every point gets in the coming step.
  void run() {
    if (!on_) return;
    clear();
    mark();
    collect([&](int32_t slot, int32_t local) { return (near_[slot] >> local & 1) != 0; },
            [&](const Item& item, int32_t slot, int32_t local) { add(item, slot, local); });
    arrange();
    push();
  }
  // The same in one rank of several: what its points are, with the numbers of its homes among those
  // of all, then what they get from the points of all, in the order of their homes.
  void offer(int32_t rank, const std::vector<int64_t>& homes, std::vector<Offer>& all) const {
    if (!on_) return;
    const auto all_of_them = [](int32_t, int32_t) { return true; };  // others' points are elsewhere
    collect(all_of_them, [&](const Item& item, int32_t slot, int32_t local) {
      const int32_t* b = s_.slot_coord + 4 * int64_t(slot);
      all.push_back({homes[item.home], block_key(b[0], b[1], b[2], b[3]), rank, local, item});
    });
  }
  void take(int32_t rank, const std::vector<Offer>& all) {
    if (!on_) return;
    clear();
    for (const Offer& offer : all) {
      const int32_t slot = contact_.slot(offer.slot);
      if (slot < 0) continue;
      Item item = offer.item;
      if (offer.rank != rank) item.home = -1;
      add(item, slot, offer.local);
    }
    arrange();
    push();
  }

 private:
  static constexpr int64_t kCellGrain = 32;

  // Whether there are points of different objects.
  bool several() const {
    bool differ = false;
    for (int64_t f = 1; s_.object != nullptr && f < s_.fields; ++f)
      differ = differ || s_.object[f] != s_.object[0];
    return differ;
  }

  // What the points of a row of materials have in common.
  struct Row {
    TouchMatter matter;
    double lag;
  };
  // Points near a cell: their numbers and places, and room for what is computed of them.
  struct Others {
    std::vector<int32_t> item;
    std::vector<double> x[3], r2;

    void clear() {
      item.clear();
      for (auto& along : x) along.clear();
    }
  };
  // Cell of a slot with such points, which follow each other.
  struct Cell {
    int32_t slot, local, first, count;
  };
  // A point within reach of another, and their distance [cells].
  struct Near {
    int32_t item;
    double r2;
  };

  void push() {
    nears_.resize((cells_.size() + kCellGrain - 1) / kCellGrain);
    const auto each = [&](const auto& f) {
      parallel_for(static_cast<int64_t>(nears_.size()), 1, [&](int64_t begin, int64_t end) {
        Others others;
        for (int64_t chunk = begin; chunk < end; ++chunk) {
          const int64_t last =
              std::min<int64_t>((chunk + 1) * kCellGrain, static_cast<int64_t>(cells_.size()));
          for (int64_t i = chunk * kCellGrain; i < last; ++i) f(cells_[i], nears_[chunk], others);
        }
      });
    };
    for (auto& nears : nears_) nears.clear();
    each([&](const Cell& cell, std::vector<Near>& nears, Others& others) {
      find(cell, nears, others);
    });
    each([&](const Cell& cell, const std::vector<Near>& nears, Others&) { push(cell, nears); });
    for (const Item& item : items_)
      if (item.pushed && item.home >= 0) homes_[item.home] = 1;
  }

  // The homes near blocks that fields share, as f(home, readers, first and last of its points).
  template <typename F>
  void each_shared(const F& f) const {
    const HomeList<T>& list = s_.homes();
    for (int64_t h = 0; h < s_.clock->homes; ++h) {
      const uint32_t readers = ContactPlan<T>::readers(contact_.around_home(h));
      if (readers == 0) continue;
      const int64_t begin = std::clamp<int64_t>(list.start[h], 0, s_.count);
      f(h, readers, begin, begin + std::clamp<int64_t>(list.count[h], 0, s_.count - begin));
    }
  }
  // Slot of a cell of a home that is one of readers, or -1.
  int32_t slot(int64_t h, uint32_t readers, uint32_t word) const {
    if ((readers >> kPlaceOf.half[word] & 1u) == 0) return -1;
    const int32_t slot = s_.neighbour[kNeighbours * h + kPlaceOf.block[word]];
    return slot < s_.clock->slots ? slot : -1;
  }

  // Which cells of slots lie beside cells with points of another object, as bits of near_.
  void mark() {
    std::fill(near_.begin(), near_.end(), 0);
    filled_.assign(near_.size(), 0);
    each_shared([&](int64_t h, uint32_t readers, int64_t begin, int64_t end) {
      uint64_t words[8] = {};
      for (int64_t p = begin; p < end; ++p) {
        const uint32_t word = s_.meta[p] & 511u;
        words[word >> 6] |= uint64_t(1) << (word & 63);
      }
      for (uint32_t i = 0; i < 8; ++i)
        for (uint64_t left = words[i]; left != 0; left &= left - 1) {
          const uint32_t word = 64 * i + static_cast<uint32_t>(std::countr_zero(left));
          const int32_t there = slot(h, readers, word);
          if (there >= 0) filled_[there] |= uint64_t(1) << kPlaceOf.local[word];
        }
    });
    for (size_t slot = 0; slot < filled_.size(); ++slot) {
      if (filled_[slot] == 0) continue;
      const int32_t own = s_.object[s_.slot_coord[4 * slot + 3]];
      place(site_[slot]);
      const int32_t* around = around_.data() + kNeighbours * int64_t(site_[slot]);
      each_beside(filled_[slot], [&](int block, uint64_t cells) {
        if (around[block] < 0) return;
        const int32_t* slots = s_.site_slots + kSiteFields * int64_t(around[block]);
        for (int f = 0; f < kSiteFields && slots[f] >= 0; ++f)
          if (s_.object[s_.slot_coord[4 * int64_t(slots[f]) + 3]] != own) near_[slots[f]] |= cells;
      });
    }
  }

  // Those of them for which wanted(slot, cell), as f(item, slot, cell).
  template <typename W, typename F>
  void collect(const W& wanted, const F& f) const {
    const double dx = double(s_.dx);
    each_shared([&](int64_t h, uint32_t readers, int64_t begin, int64_t end) {
      int32_t slots[512];
      bool any = false;
      for (uint32_t word = 0; word < 512; ++word) {
        if (!kPlaceOf.used[word]) continue;
        slots[word] = slot(h, readers, word);
        if (slots[word] >= 0 && !wanted(slots[word], kPlaceOf.local[word])) slots[word] = -1;
        any = any || slots[word] >= 0;
      }
      const int32_t* b = s_.homes().coord + 4 * h;
      for (int64_t p = begin; any && p < end; ++p) {
        const uint32_t meta = s_.meta[p], word = meta & 511u;
        if (!kPlaceOf.used[word] || slots[word] < 0) continue;
        const Row& row = rows_[s_.row_of(meta)];
        Item item{};
        item.point = static_cast<int32_t>(p);
        item.home = static_cast<int32_t>(h);
        for (int axis = 0; axis < 3; ++axis) {
          item.x[axis] =
              4.0 * b[axis] + meta_cell(meta, axis) - 0.5 + double(s_.offset[3 * p + axis]);
          item.v[axis] = double(s_.velocity[3 * p + axis]) / dx;
        }
        item.matter = row.matter;
        item.lag = row.lag;
        item.share = touch_share(double(s_.radius[2 * int64_t(s_.id[p])]) / dx);
        item.kept = double(s_.radius[2 * int64_t(s_.id[p]) + 1]);
        f(item, slots[word], kPlaceOf.local[word]);
      }
    });
  }
  void clear() {
    for (const Cell& cell : cells_) first_[int64_t(cell.slot) * kBlockNodes + cell.local] = -1;
    for (const Item& item : items_) {
      if (item.home < 0) continue;
      std::fill_n(given_.data() + 4 * int64_t(item.point), 4, T(0));
      homes_[item.home] = 0;
    }
    cells_.clear();
    found_.clear();
    cell_of_.clear();
  }
  void add(const Item& item, int32_t slot, int32_t local) {
    int32_t& cell = first_[int64_t(slot) * kBlockNodes + local];
    if (cell < 0) {
      cell = static_cast<int32_t>(cells_.size());
      cells_.push_back({slot, local, 0, 0});
      place(site_[slot]);
    }
    ++cells_[cell].count;
    found_.push_back(item);
    cell_of_.push_back(cell);
  }
  // What was added, cell by cell.
  void arrange() {
    int32_t first = 0;
    for (Cell& cell : cells_) {
      cell.first = first;
      first += cell.count;
      cell.count = 0;
    }
    items_.resize(found_.size());
    for (auto& along : x_) along.resize(found_.size());
    for (size_t i = 0; i < found_.size(); ++i) {
      Cell& cell = cells_[cell_of_[i]];
      const int32_t at = cell.first + cell.count++;
      items_[at] = found_[i];
      for (int axis = 0; axis < 3; ++axis) x_[axis][at] = found_[i].x[axis];
    }
  }

  // The sites around one, once.
  void place(int32_t site) {
    int32_t* around = around_.data() + kNeighbours * int64_t(site);
    if (around[0] != -2) return;
    const uint64_t key = key_[site];
    for (int n = 0; n < kNeighbours; ++n) {
      const uint64_t wanted =
          block_key(key_block(key, 0) + n / 9 - 1, key_block(key, 1) + n / 3 % 3 - 1,
                    key_block(key, 2) + n % 3 - 1, 0);
      const auto at = std::lower_bound(key_.begin(), key_.end(), wanted);
      around[n] = at != key_.end() && *at == wanted ? static_cast<int32_t>(at - key_.begin()) : -1;
    }
  }

  // Points of other objects in the 27 cells about one.
  void gather(const Cell& cell, Others& others) const {
    others.clear();
    const int32_t own = s_.object[s_.slot_coord[4 * int64_t(cell.slot) + 3]];
    const int32_t* around = around_.data() + kNeighbours * int64_t(site_[cell.slot]);
    for (int o = 0; o < kNeighbours; ++o) {
      const int there = kNear.at[cell.local][o];
      const int32_t site = around[kNear.block[cell.local][o]];
      if (site < 0) continue;
      const int32_t* slots = s_.site_slots + kSiteFields * int64_t(site);
      for (int f = 0; f < kSiteFields && slots[f] >= 0; ++f) {
        const int32_t c = first_[int64_t(slots[f]) * kBlockNodes + there];
        if (c < 0 || s_.object[s_.slot_coord[4 * int64_t(slots[f]) + 3]] == own) continue;
        const int32_t first = cells_[c].first, last = first + cells_[c].count;
        others.item.resize(others.item.size() + cells_[c].count);
        std::iota(others.item.end() - cells_[c].count, others.item.end(), first);
        for (int axis = 0; axis < 3; ++axis)
          others.x[axis].insert(others.x[axis].end(), x_[axis].begin() + first,
                                x_[axis].begin() + last);
      }
    }
  }

  // How much of other bodies the points of a cell find. Distances first: few of them are short
  // enough, and a loop without a choice is a fast one.
  void find(const Cell& cell, std::vector<Near>& nears, Others& others) {
    gather(cell, others);
    const size_t count = others.item.size();
    const double *x = others.x[0].data(), *y = others.x[1].data(), *z = others.x[2].data();
    others.r2.resize(count);
    double* r2 = others.r2.data();
    for (int32_t i = cell.first; i < cell.first + cell.count; ++i) {
      Item& p = items_[i];
      p.first_near = static_cast<int32_t>(nears.size());
      for (size_t o = 0; o < count; ++o) {
        const double d[3] = {p.x[0] - x[o], p.x[1] - y[o], p.x[2] - z[o]};
        r2[o] = d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
      }
      TouchFound found{};
      for (size_t o = 0; o < count; ++o) {
        if (!(r2[o] < kTouchReach * kTouchReach)) continue;
        const Item& q = items_[others.item[o]];
        const double d[3] = {p.x[0] - x[o], p.x[1] - y[o], p.x[2] - z[o]};
        add_found(q.matter, d, r2[o], p.v, q.v, found);
        nears.push_back({others.item[o], r2[o]});
      }
      p.nears = static_cast<int32_t>(nears.size()) - p.first_near;
      p.pushed = false;
      p.energy = touch_energy(p.matter, p.share, p.lag, p.kept, found);
    }
  }

  // What the points of a cell get. Two that both find too little of each other's body push nothing.
  void push(const Cell& cell, const std::vector<Near>& nears) {
    for (int32_t i = cell.first; i < cell.first + cell.count; ++i) {
      Item& p = items_[i];
      if (p.home < 0) continue;
      double sum[3] = {};
      for (int32_t n = p.first_near; n < p.first_near + p.nears; ++n) {
        const Item& q = items_[nears[n].item];
        if (p.energy == 0.0 && q.energy == 0.0) continue;
        const double f =
            touch_force(p.energy, p.matter.volume, q.energy, q.matter.volume, nears[n].r2);
        for (int axis = 0; axis < 3; ++axis) sum[axis] += f * (p.x[axis] - q.x[axis]);
      }
      touch_given(sum, s_.clock->dt, double(s_.dx), given_.data() + 4 * int64_t(p.point));
      p.pushed = sum[0] != 0.0 || sum[1] != 0.0 || sum[2] != 0.0;
    }
  }

  const SolverView<T>& s_;
  const ContactPlan<T>& contact_;
  bool on_ = false;
  std::vector<Row> rows_;            // [rows]
  std::vector<uint64_t> near_;       // [slots] cells beside points of another object, as bits
  std::vector<uint64_t> filled_;     // [slots] cells with points
  std::vector<int32_t> first_;       // [slots, 64] number of each cell with points, or -1
  std::vector<int32_t> site_;        // [slots]
  std::vector<uint64_t> key_;        // [sites] ascending
  std::vector<int32_t> around_;      // [sites, 27] sites around one; -2: not looked for yet
  std::vector<Item> found_, items_;  // as they were found, and cell by cell
  std::vector<int32_t> cell_of_;     // of those found
  std::vector<double> x_[3];         // places of items
  std::vector<Cell> cells_;
  std::vector<std::vector<Near>> nears_;  // of each kCellGrain cells
  std::vector<T> given_;                  // [N, 4]
  std::vector<uint8_t> homes_;            // [homes]
  std::vector<T> push_;                   // [slots, 64, 4]
};

}  // namespace gsf::cpu
