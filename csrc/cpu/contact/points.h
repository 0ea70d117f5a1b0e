// Points of the resident solver that points of other bodies push: core/collider/touch.h.
#pragma once

#include "core/solver/points.h"
#include "cpu/solver/contact.h"
#include "cpu/solver/surface.h"

namespace gsf::cpu {

template <typename T>
class TouchPlan {
 public:
  TouchPlan(const SolverView<T>& s, const ContactPlan<T>& contact) : s_(s), contact_(contact) {}

  // Tables of the blocks; again after each build.
  void make() {
    const SolverClock& c = *s_.clock;
    on_ = s_.object != nullptr && s_.radius != nullptr && contact_.any();
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
    int32_t point, home, next;  // next: of its cell; home: -1 for points of another rank
    bool pushed;
    double x[3], v[3];  // place in cells and velocity in cells per second
    TouchMatter matter;
    double share;   // of other bodies at which it touches
    double lag;     // time of the damping [s]
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
    push();
  }

 private:
  static constexpr int64_t kCellGrain = 32;

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
    void add(int32_t i, const double* place) {
      item.push_back(i);
      for (int axis = 0; axis < 3; ++axis) x[axis].push_back(place[axis]);
    }
  };
  // Cell of a slot with such points.
  struct Cell {
    int32_t slot, local;
    bool meets;
  };

  void push() {
    const auto each = [&](const auto& f) {
      parallel_for(static_cast<int64_t>(cells_.size()), kCellGrain,
                   [&](int64_t begin, int64_t end) {
                     Others others, deep;
                     for (int64_t i = begin; i < end; ++i) f(cells_[i], others, deep);
                   });
    };
    each([&](Cell& cell, Others& others, Others&) { find(cell, others); });
    each([&](const Cell& cell, Others& others, Others& deep) { push(cell, others, deep); });
    for (const Item& item : items_)
      if (item.pushed && item.home >= 0) homes_[item.home] = 1;
  }

  // Calls f(home, point, its word, slot, cell of it) for the points near blocks that fields share.
  template <typename F>
  void each_shared(const F& f) const {
    const HomeList<T>& list = s_.homes();
    for (int64_t h = 0; h < s_.clock->homes; ++h) {
      const uint32_t shared = ContactPlan<T>::readers(contact_.around_home(h));
      if (shared == 0) continue;
      const int64_t begin = std::clamp<int64_t>(list.start[h], 0, s_.count);
      const int64_t end = begin + std::clamp<int64_t>(list.count[h], 0, s_.count - begin);
      for (int64_t p = begin; p < end; ++p) {
        const uint32_t meta = s_.meta[p];
        if (!ContactPlan<T>::reads(shared, meta)) continue;
        int block = 0, local = 0;
        for (int axis = 0; axis < 3; ++axis) {
          const int cell = std::min(meta_cell(meta, axis), kLastCell) - 1;
          block = 3 * block + (cell >> 2) + 1;
          local = 4 * local + (cell & 3);
        }
        const int32_t slot = s_.neighbour[kNeighbours * h + block];
        if (slot >= 0 && slot < s_.clock->slots) f(h, p, meta, slot, local);
      }
    }
  }

  // Which cells of slots lie beside cells with points of another object, as bits of near_.
  void mark() {
    std::fill(near_.begin(), near_.end(), 0);
    filled_.assign(near_.size(), 0);
    each_shared([&](int64_t, int64_t, uint32_t, int32_t slot, int32_t local) {
      filled_[slot] |= uint64_t(1) << local;
    });
    for (size_t slot = 0; slot < filled_.size(); ++slot) {
      if (filled_[slot] == 0) continue;
      const int32_t own = s_.object[s_.slot_coord[4 * slot + 3]];
      place(site_[slot]);
      const int32_t* around = around_.data() + kNeighbours * int64_t(site_[slot]);
      for (uint64_t left = filled_[slot]; left != 0; left &= left - 1) {
        const int local = __builtin_ctzll(left);
        for (int o = 0; o < kNeighbours; ++o) {
          const int there = kNear.at[local][o];
          const int32_t site = around[kNear.block[local][o]];
          if (site < 0) continue;
          const int32_t* slots = s_.site_slots + kSiteFields * int64_t(site);
          for (int f = 0; f < kSiteFields && slots[f] >= 0; ++f)
            if (s_.object[s_.slot_coord[4 * int64_t(slots[f]) + 3]] != own)
              near_[slots[f]] |= uint64_t(1) << there;
        }
      }
    }
  }

  // Those of them for which wanted(slot, cell), as f(item, slot, cell).
  template <typename W, typename F>
  void collect(const W& wanted, const F& f) const {
    const double dx = double(s_.dx);
    each_shared([&](int64_t h, int64_t p, uint32_t meta, int32_t slot, int32_t local) {
      if (!wanted(slot, local)) return;
      const int32_t* b = s_.homes().coord + 4 * h;
      const Row& row = rows_[s_.row_of(meta)];
      Item item{};
      item.point = static_cast<int32_t>(p);
      item.home = static_cast<int32_t>(h);
      for (int axis = 0; axis < 3; ++axis) {
        const int cell = std::min(meta_cell(meta, axis), kLastCell) - 1;
        item.x[axis] = 4.0 * b[axis] + cell + 0.5 + double(s_.offset[3 * p + axis]);
        item.v[axis] = double(s_.velocity[3 * p + axis]) / dx;
      }
      item.matter = row.matter;
      item.lag = row.lag;
      item.share = touch_share(double(s_.radius[s_.id[p]]) / dx);
      f(item, slot, local);
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
    items_.clear();
  }
  void add(const Item& item, int32_t slot, int32_t local) {
    int32_t& first = first_[int64_t(slot) * kBlockNodes + local];
    if (first < 0) {
      cells_.push_back({slot, local, false});
      place(site_[slot]);
    }
    items_.push_back(item);
    items_.back().next = first;
    first = static_cast<int32_t>(items_.size()) - 1;
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
        int32_t i = first_[int64_t(slots[f]) * kBlockNodes + there];
        if (i < 0 || s_.object[s_.slot_coord[4 * int64_t(slots[f]) + 3]] == own) continue;
        for (; i >= 0; i = items_[i].next) others.add(i, items_[i].x);
      }
    }
  }

  // Distances first: few of them are short enough, and a loop without a choice is a fast one.
  template <typename F>
  void each_near(const Item& p, Others& others, const F& f) const {
    const size_t count = others.item.size();
    const double *x = others.x[0].data(), *y = others.x[1].data(), *z = others.x[2].data();
    others.r2.resize(count);
    double* r2 = others.r2.data();
    for (size_t i = 0; i < count; ++i) {
      const double d[3] = {p.x[0] - x[i], p.x[1] - y[i], p.x[2] - z[i]};
      r2[i] = d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
    }
    for (size_t i = 0; i < count; ++i) {
      if (!(r2[i] < kTouchReach * kTouchReach)) continue;
      const double d[3] = {p.x[0] - x[i], p.x[1] - y[i], p.x[2] - z[i]};
      f(items_[others.item[i]], d, r2[i]);
    }
  }

  // How much of other bodies the points of a cell find.
  void find(Cell& cell, Others& others) {
    gather(cell, others);
    cell.meets = !others.item.empty();
    for (int32_t i = first_[int64_t(cell.slot) * kBlockNodes + cell.local]; i >= 0;
         i = items_[i].next) {
      Item& p = items_[i];
      TouchFound found{};
      if (cell.meets)
        each_near(p, others, [&](const Item& q, const double* d, double r2) {
          add_found(q.matter, d, r2, p.v, q.v, found);
        });
      p.pushed = false;
      p.energy = touch_energy(p.matter, p.share, p.lag, found);
    }
  }

  // What the points of a cell get. Two that both find too little of each other's body push nothing.
  void push(const Cell& cell, Others& others, Others& deep) {
    if (!cell.meets) return;
    gather(cell, others);
    deep.clear();
    for (const int32_t i : others.item)
      if (items_[i].energy != 0.0) deep.add(i, items_[i].x);
    for (int32_t i = first_[int64_t(cell.slot) * kBlockNodes + cell.local]; i >= 0;
         i = items_[i].next) {
      Item& p = items_[i];
      if (p.home < 0) continue;
      double sum[3] = {};
      each_near(p, p.energy != 0.0 ? others : deep, [&](const Item& q, const double* d, double r2) {
        const double f = touch_force(p.energy, p.matter.volume, q.energy, q.matter.volume, r2);
        for (int axis = 0; axis < 3; ++axis) sum[axis] += f * d[axis];
      });
      touch_given(sum, s_.clock->dt, double(s_.dx), given_.data() + 4 * int64_t(p.point));
      p.pushed = sum[0] != 0.0 || sum[1] != 0.0 || sum[2] != 0.0;
    }
  }

  const SolverView<T>& s_;
  const ContactPlan<T>& contact_;
  bool on_ = false;
  std::vector<Row> rows_;         // [rows]
  std::vector<uint64_t> near_;    // [slots] cells beside points of another object, as bits
  std::vector<uint64_t> filled_;  // [slots] cells with points
  std::vector<int32_t> first_;    // [slots, 64] first item of each cell, or -1
  std::vector<int32_t> site_;     // [slots]
  std::vector<uint64_t> key_;     // [sites] ascending
  std::vector<int32_t> around_;   // [sites, 27] sites around one; -2: not looked for yet
  std::vector<Item> items_;
  std::vector<Cell> cells_;
  std::vector<T> given_;        // [N, 4]
  std::vector<uint8_t> homes_;  // [homes]
  std::vector<T> push_;         // [slots, 64, 4]
};

}  // namespace gsf::cpu
