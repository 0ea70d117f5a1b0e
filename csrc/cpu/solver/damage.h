// The damage field of phase-field matter on the CPU (core/solver/damage.h): node sums of the points
// near damage, red-black SOR within bounds, and back to the points. Sums are in double, in an order
// that hangs on neither threads nor loading.
#pragma once

#include "core/solver/damage.h"
#include "cpu/solver/homes.h"

namespace gsf::cpu {

// Of the 27 blocks around a home, those that the stencil of a particle touches, by the nine bits of
// l in a meta word.
struct ReachTable {
  uint32_t blocks[512];
  ReachTable() : blocks{} {
    for (uint32_t word = 0; word < 512; ++word)
      for (int corner = 0; corner < 8; ++corner) {
        int block = 0;
        for (int axis = 0; axis < 3; ++axis) {
          const int stored = static_cast<int>(word >> (3 * axis) & 7u);
          const int l = stored < kLastCell ? stored : kLastCell;
          block = 3 * block + window_block(l + (corner >> axis & 1) * 2);
        }
        blocks[word] |= 1u << block;
      }
  }
};
inline const ReachTable kReach;

template <typename T>
class DamagePass {
 public:
  explicit DamagePass(const SolverView<T>& s) : s_(s) {
    for (int64_t row = 0; row < s.row_count; ++row) {
      if (s.law[row] != kPhaseField) {
        alone_ = false;
        continue;
      }
      const T* r = s.rows + row * kRowColumns;
      at2_ = is_at2(load_material(r));
      empty_ = std::max(empty_, kEmptyNode * double(r[kStressColumn]));
    }
    active_ = active_alpha<T>(at2_);
  }

  // Again after each build.
  void plan() {
    const int64_t slots = s_.clock->slots;
    keys_.resize(slots);
    for (int64_t i = 0; i < slots; ++i) {
      const int32_t* b = s_.slot_coord + 4 * i;
      keys_[i] = block_key(b[0], b[1], b[2], b[3]);
    }
    around_.assign(kNeighbours * slots, kUnknown);
  }

  // One solve; peaks of the points after it.
  void run(const HomePass<T>& pass) {
    if (!find_active(pass)) return;
    scatter(pass);
    prepare();
    relax();
    gather(pass);
  }

 private:
  bool is_phase(int64_t p) const { return s_.law[s_.row_of(s_.meta[p])] == kPhaseField; }
  // The slots around a slot, -1 where there is none; looked up when first asked for after a build.
  const int32_t* around(int32_t slot) {
    int32_t* found = around_.data() + kNeighbours * int64_t(slot);
    if (found[0] != kUnknown) return found;
    const int32_t* b = s_.slot_coord + 4 * int64_t(slot);
    for (int n = 0; n < kNeighbours; ++n) {
      const uint64_t wanted =
          block_key(b[0] + n / 9 - 1, b[1] + n / 3 % 3 - 1, b[2] + n % 3 - 1, b[3]);
      const auto at = std::lower_bound(keys_.begin(), keys_.end(), wanted);
      found[n] = at != keys_.end() && *at == wanted ? static_cast<int32_t>(at - keys_.begin()) : -1;
    }
    return found;
  }
  template <typename F>
  void for_particles(int64_t h, const F& f) const {
    const HomeList<T>& list = s_.homes();
    const int64_t begin = std::clamp<int64_t>(list.start[h], 0, s_.count);
    const int64_t end = begin + std::clamp<int64_t>(list.count[h], 0, s_.count - begin);
    for (int64_t p = begin; p < end; ++p) f(p);
  }

  // Slots of points with damage or near their threshold, and those around them.
  bool find_active(const HomePass<T>& pass) {
    const SolverClock& c = *s_.clock;
    number_.assign(c.slots, kNoPart);
    extent_.resize(c.slots);
    std::atomic<bool> any{false};
    parallel_for(c.homes, kHomeGrain, [&](int64_t begin, int64_t end) {
      for (int64_t h = begin; h < end; ++h) {
        int hot = 0;  // most homes have no such point: no branch per point there
        for_particles(h, [&](int64_t p) {
          hot |= int(s_.alpha[p] > active_) | int(s_.peak[p] > T(-kBrokenDamage));
        });
        if (hot == 0) continue;
        for_particles(h, [&](int64_t p) {
          if (!takes_part(s_.alpha[p], s_.peak[p], active_) || !is_phase(p)) return;
          const int32_t slot = s_.neighbour[kNeighbours * h + middle_block(s_.meta[p])];
          if (slot < 0 || slot >= c.slots) return;
          std::atomic_ref<int32_t>(number_[slot]).store(0, std::memory_order_relaxed);
          any.store(true, std::memory_order_relaxed);
        });
      }
    });
    if (!any) return false;
    slots_.clear();
    std::vector<int32_t> seeds;
    for (int64_t i = 0; i < c.slots; ++i)
      if (number_[i] == 0) seeds.push_back(static_cast<int32_t>(i));
    for (const int32_t seed : seeds)
      for (int n = 0; n < kNeighbours; ++n) {
        const int32_t slot = around(seed)[n];
        if (slot >= 0) number_[slot] = 0;
      }
    for (int color = 0; color < kColors; ++color) {
      homes_[color].clear();
      for (const int32_t h : pass.colors_[color]) {
        bool meets = false;
        for (int n = 0; n < kNeighbours && !meets; ++n) {
          const int32_t slot = s_.neighbour[kNeighbours * int64_t(h) + n];
          meets = slot >= 0 && slot < c.slots && number_[slot] >= 0;
        }
        if (!meets) continue;
        homes_[color].push_back(h);
        mark_matter(pass.box_[h], s_.neighbour + kNeighbours * int64_t(h));
      }
    }
    // What is around powder is mostly empty: no rows for that.
    for (int64_t i = 0; i < c.slots; ++i)
      if (number_[i] == kMatter) {
        number_[i] = static_cast<int32_t>(slots_.size());
        slots_.push_back(static_cast<int32_t>(i));
      } else if (number_[i] == 0) {
        number_[i] = kEmpty;
      }
    return true;
  }

  // Nodes [lo, hi) of a slot that particles touch, on each axis.
  struct Extent {
    int8_t lo[3], hi[3];
  };
  void mark_matter(const Box& box, const int32_t* neighbour) {
    int lo[3][3], hi[3][3];  // [axis][block of the window]
    for (int axis = 0; axis < 3; ++axis)
      for (int block = 0; block < 3; ++block) {
        const int first = 4 * block - 3;  // window_block(first) is the first to be `block`
        lo[axis][block] = std::max<int>(box.lo[axis], first) - first;
        hi[axis][block] = std::min<int>(box.hi[axis], first + 4) - first;
      }
    for (int n = 0; n < kNeighbours; ++n) {
      const int block[3] = {n / 9, n / 3 % 3, n % 3};
      bool touched = true;
      for (int axis = 0; axis < 3; ++axis)
        touched = touched && lo[axis][block[axis]] < hi[axis][block[axis]];
      const int32_t slot = neighbour[n];
      if (!touched || slot < 0 || slot >= s_.clock->slots || number_[slot] < 0) continue;
      if (number_[slot] != kMatter) extent_[slot] = Extent{{4, 4, 4}, {0, 0, 0}};
      number_[slot] = kMatter;
      for (int axis = 0; axis < 3; ++axis) {
        int8_t &l = extent_[slot].lo[axis], &h = extent_[slot].hi[axis];
        l = std::min<int8_t>(l, static_cast<int8_t>(lo[axis][block[axis]]));
        h = std::max<int8_t>(h, static_cast<int8_t>(hi[axis][block[axis]]));
      }
    }
  }
  // f(local index) for the nodes of an active slot that particles touch; of one colour, or of all
  // if that is below 0.
  template <typename F>
  void for_each_node(int64_t row, int colour, const F& f) const {
    const Extent& e = extent_[slots_[row]];
    for (int i = e.lo[0]; i < e.hi[0]; ++i)
      for (int j = e.lo[1]; j < e.hi[1]; ++j) {
        const int along = local_index(i, j, 0), step = colour < 0 ? 1 : 2;
        const int first = e.lo[2] + (colour >= 0 && node_colour(along + e.lo[2]) != colour);
        for (int k = first; k < e.hi[2]; k += step) f(along + k);
      }
  }

  using Sums = double __attribute__((vector_size(8 * kDamageSums)));
  using P = Pack<T>;
  static constexpr int kLanes = P::kLanes;

  // f(place in the window, row of the node, nodes in a row) for the nodes of home h; the row is
  // below 0 where they take no part.
  template <typename F>
  void for_each_run(const HomePass<T>& pass, int64_t h, const F& f) const {
    pass.for_each_run(h, [&](int t, int64_t node, int run) {
      const int32_t n = number_[node / kBlockNodes];
      f(t, n < 0 ? int64_t(-1) : n * int64_t(kBlockNodes) + node % kBlockNodes, run);
    });
  }
  // f(first, last) for the stretches of home h's particles, in the order of their cells, that share
  // a cell, fit into a packet and touch one of these of the 27 blocks.
  template <typename F>
  void for_each_cell(const HomePass<T>& pass, int64_t h, uint32_t blocks, const F& f) const {
    const auto r = pass.range(h);
    for (int64_t at = r.begin; at < r.end;) {
      const uint32_t cell = s_.meta[s_.entry[at]] & 511u;
      int64_t last = at + 1;
      while (last < r.end && last < at + kLanes && (s_.meta[s_.entry[last]] & 511u) == cell) ++last;
      if ((kReach.blocks[cell] & blocks) != 0) f(at, last);
      at = last;
    }
  }
  static uint32_t block_bit(int t) {  // of place t of the window
    return 1u << ((window_block(t / (kWindowEdge * kWindowEdge)) * 3 +
                   window_block(t / kWindowEdge % kWindowEdge)) *
                      3 +
                  window_block(t % kWindowEdge));
  }

  // What the lanes of a packet give, four numbers each; nothing where another law is.
  void given(const Packet<T>& packet, int used, Quad<T>* out) const {
    const auto column = [&](int c) {
      return pack_of<T>([&](int lane) {
        const int64_t row = s_.row_of(packet.meta[lane]);
        return lane < used && s_.law[row] == kPhaseField ? s_.rows[row * kRowColumns + c] : T(0);
      });
    };
    P volume, length;
    if (alone_ && used == kLanes && packet.same_rows()) {
      const T* row = s_.rows + int64_t(s_.row_of(packet.meta[0])) * kRowColumns;
      volume = P(row[kStressColumn]), length = P(row[4]);
    } else {
      volume = column(kStressColumn), length = column(4);
    }
    P four[kDamageSums];
    damage_given(volume, length * P(s_.inv_dx), packet.load1(s_.alpha), packet.load1(s_.peak),
                 four);
    transpose(four, out);
  }

  void scatter(const HomePass<T>& pass) {
    nodes_.assign(slots_.size() * kBlockNodes, Sums{});
    for (const std::vector<int32_t>& homes : homes_)
      parallel_for(static_cast<int64_t>(homes.size()), 1, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; ++i) {
          Sums sums[kWindowNodes];
          uint32_t live = 0;  // blocks that take part
          for_each_run(pass, homes[i], [&](int t, int64_t row, int run) {
            std::fill_n(sums + t, run, Sums{});
            if (row >= 0) live |= block_bit(t);
          });
          if (live == 0) continue;
          for_each_cell(pass, homes[i], live,
                        [&](int64_t at, int64_t last) { scatter_cell(at, last, sums); });
          for_each_run(pass, homes[i], [&](int t, int64_t row, int run) {
            for (int n = 0; row >= 0 && n < run; ++n) nodes_[row + n] += sums[t + n];
          });
        }
      });
  }
  // Particles [at, last), all of one cell. In single precision two at once.
  [[gnu::always_inline]] void scatter_cell(int64_t at, int64_t last, Sums* sums) const {
    using Give = PacketMomentum<T>;
    using Raw = typename P::Raw;
    const Packet<T> packet(s_, s_.entry + at, last - at);
    const int used = static_cast<int>(last - at);
    P offset[3];
    packet.load3(s_.offset, offset);
    const Stencil<P> stencil = stencil_at(offset);
    Quad<T> four[kLanes];
    given(packet, used, four);
    Sums* node = sums + window_node(packet.meta[0]);
    for (int i = 0; i < 3; ++i, node += kWindowEdge * kWindowEdge) {
      P w[9];
      for (int n = 0; n < 9; ++n)
        w[n] = stencil.w[0][i] * stencil.w[1][n / 3] * stencil.w[2][n % 3];
      Raw sum[9] = {};
      int lane = 0;
      if constexpr (sizeof(T) == 4)
        for (; lane < used; lane += 2) {  // what is beyond gives nothing
          const Raw two = load_pack(reinterpret_cast<const T*>(four + lane)).v;
          for (int n = 0; n < 9; ++n) sum[n] += Give::two_lanes(w[n], lane) * two;
        }
      for (; lane < used; ++lane)
        for (int n = 0; n < 9; ++n) sum[n] += P(w[n][lane]).v * Give::one_lane(four[lane]);
      for (int n = 0; n < 9; ++n)
        node[n / 3 * kWindowEdge + n % 3] += Give::doubles(Give::both_lanes(sum[n]));
    }
  }

  // Edges towards the six neighbours of every node, the right side, and the first guess.
  void prepare() {
    const int64_t count = static_cast<int64_t>(slots_.size());
    edge_.resize(nodes_.size());
    field_.resize(nodes_.size());
    parallel_for(count, 1, [&](int64_t begin, int64_t end) {
      for (int64_t b = begin; b < end; ++b) {
        int32_t face[6];  // slots beyond the faces
        for (int f = 0; f < 6; ++f) face[f] = around(slots_[b])[face_block(f)];
        for_each_node(b, -1, [&](int local) {
          const int64_t n = b * kBlockNodes + local;
          const Sums& node = nodes_[n];
          Edge& e = edge_[n];
          const double sums[kDamageSums] = {node[0], node[1], node[2], node[3]};
          const DamageNode now = damage_node(sums, at2_, empty_, [&](int f) {
            bool inside;
            const int there = face_node(local, f, inside);
            const int32_t slot = inside ? slots_[b] : face[f];
            e.near[f] = 0;
            e.weight[f] = 0.0;
            if (slot < 0) return 0.0;
            if (number_[slot] < 0) return number_[slot] == kEmpty ? 0.0 : node[kStiffSum];
            const int64_t m = int64_t(number_[slot]) * kBlockNodes + there;
            if (!(nodes_[m][kVolumeSum] > empty_)) return 0.0;
            e.near[f] = static_cast<int32_t>(m);
            return e.weight[f] = edge_weight(node[kStiffSum], nodes_[m][kStiffSum]);
          });
          field_[n] = now.value;
          e.right = now.right;
          e.inverse = now.inverse;
        });
      }
    });
  }

  void relax() {
    const int64_t count = static_cast<int64_t>(slots_.size());
    for (int sweep = 0; sweep < 2 * kSweeps; ++sweep)
      parallel_for(count, 8, [&](int64_t begin, int64_t end) {
        for (int64_t b = begin; b < end; ++b)
          for_each_node(b, sweep % 2, [&](int local) {
            const Edge& e = edge_[b * kBlockNodes + local];
            if (e.inverse == 0.0) return;
            double sum = e.right;
            for (int f = 0; f < 6; ++f) sum += e.weight[f] * field_[e.near[f]];
            double& d = field_[b * kBlockNodes + local];
            d = relaxed(d, sum, e.inverse);
          });
      });
  }

  void gather(const HomePass<T>& pass) {
    for (const std::vector<int32_t>& homes : homes_)
      parallel_for(static_cast<int64_t>(homes.size()), 1, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; ++i) {
          T field[kWindowNodes];
          uint32_t live = 0;  // elsewhere no point gets more than it has
          for_each_run(pass, homes[i], [&](int t, int64_t row, int run) {
            T most(0);
            for (int n = 0; n < run; ++n) {
              field[t + n] = row >= 0 ? T(field_[row + n]) : T(0);
              most = std::max(most, field[t + n]);
            }
            if (most > T(0)) live |= block_bit(t);
          });
          if (live == 0) continue;
          for_each_cell(pass, homes[i], live,
                        [&](int64_t at, int64_t last) { gather_cell(at, last, field); });
        }
      });
  }
  [[gnu::always_inline]] void gather_cell(int64_t at, int64_t last, const T* field) const {
    const Packet<T> packet(s_, s_.entry + at, last - at);
    P offset[3];
    packet.load3(s_.offset, offset);
    const Stencil<P> stencil = stencil_at(offset);
    const T* first = field + window_node(packet.meta[0]);
    P found(0);
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) {
        const T* f = first + (i * kWindowEdge + j) * kWindowEdge;
        found +=
            stencil.w[0][i] * stencil.w[1][j] *
            (stencil.w[2][0] * P(f[0]) + stencil.w[2][1] * P(f[1]) + stencil.w[2][2] * P(f[2]));
      }
    if (mask_bits(found > P(0)) == 0) return;
    for (int lane = 0; lane < static_cast<int>(last - at); ++lane) {
      const int64_t p = packet.index[lane];
      if (alone_ || is_phase(p)) s_.peak[p] = peak_after(s_.peak[p], found[lane]);
    }
  }

  // In `number_`: takes no part; takes part, and is empty. While slots are found: 0 takes part,
  // kMatter has matter. In `around_`: not looked up.
  static constexpr int32_t kNoPart = -1, kEmpty = -2, kMatter = 1, kUnknown = -2;

  struct Edge {
    double weight[6], right, inverse;
    int32_t near[6];
  };

  const SolverView<T>& s_;
  bool at2_ = false, alone_ = true;  // alone: there is no other law
  double empty_ = 0.0;
  T active_;                             // alpha from which a point takes part
  std::vector<uint64_t> keys_;           // [slots]
  std::vector<int32_t> around_;          // [slots, 27]
  std::vector<int32_t> homes_[kColors];  // homes that take part, by colour
  std::vector<int32_t> number_;          // [slots] row of an active slot, or one of these
  std::vector<Extent> extent_;           // [slots]
  std::vector<int32_t> slots_;           // active slots
  std::vector<Sums> nodes_;
  std::vector<Edge> edge_;
  std::vector<double> field_;
};

}  // namespace gsf::cpu
