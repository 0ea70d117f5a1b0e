// The damage field of phase-field matter on the CPU (core/solver/damage.h): node sums of the points
// near damage, red-black SOR within bounds, and back to the points. Sums are in double, in an order
// that hangs on neither threads nor loading.
#pragma once

#include "core/solver/damage.h"
#include "cpu/solver/homes.h"

namespace gsf::cpu {

template <typename T>
class DamagePass {
 public:
  explicit DamagePass(const SolverView<T>& s) : s_(s) {
    for (int64_t row = 0; row < s.row_count; ++row) {
      if (s.law[row] != kPhaseField) continue;
      const T* r = s.rows + row * kRowColumns;
      at2_ = is_at2(load_material(r));
      empty_ = std::max(empty_, kEmptyNode * double(r[kStressColumn]));
    }
    active_ = active_alpha<T>(at2_);
  }

  // Again after each build.
  void plan() {
    const SolverClock& c = *s_.clock;
    keys_.resize(c.slots);
    for (int64_t i = 0; i < c.slots; ++i) {
      const int32_t* b = s_.slot_coord + 4 * i;
      keys_[i] = block_key(b[0], b[1], b[2], b[3]);
    }
    const HomeList<T>& list = s_.homes();
    for (auto& color : colors_) color.clear();
    for (int64_t h = 0; h < c.homes; ++h) {
      const int32_t* b = list.coord + 4 * h;
      colors_[(b[0] & 1) * 4 + (b[1] & 1) * 2 + (b[2] & 1)].push_back(static_cast<int32_t>(h));
    }
  }

  // One solve; peaks of the points after it.
  void run() {
    if (!find_active()) return;
    scatter();
    prepare();
    relax();
    gather();
  }

 private:
  bool is_phase(int64_t p) const { return s_.law[s_.row_of(s_.meta[p])] == kPhaseField; }
  int32_t slot_around(const int32_t* b, int n) const {
    const uint64_t wanted =
        block_key(b[0] + n / 9 - 1, b[1] + n / 3 % 3 - 1, b[2] + n % 3 - 1, b[3]);
    const auto at = std::lower_bound(keys_.begin(), keys_.end(), wanted);
    return at != keys_.end() && *at == wanted ? static_cast<int32_t>(at - keys_.begin()) : -1;
  }
  template <typename F>
  void for_particles(int64_t h, const F& f) const {
    const HomeList<T>& list = s_.homes();
    const int64_t begin = std::clamp<int64_t>(list.start[h], 0, s_.count);
    const int64_t end = begin + std::clamp<int64_t>(list.count[h], 0, s_.count - begin);
    for (int64_t p = begin; p < end; ++p) f(p);
  }

  // Slots of points with damage or near their threshold, and those around them.
  bool find_active() {
    const SolverClock& c = *s_.clock;
    number_.assign(c.slots, -1);
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
        const int32_t slot = slot_around(s_.slot_coord + 4 * int64_t(seed), n);
        if (slot >= 0) number_[slot] = 0;
      }
    for (int64_t i = 0; i < c.slots; ++i)
      if (number_[i] == 0) {
        number_[i] = static_cast<int32_t>(slots_.size());
        slots_.push_back(static_cast<int32_t>(i));
      }
    for (int color = 0; color < kColors; ++color) {
      homes_[color].clear();
      for (const int32_t h : colors_[color]) {
        bool meets = false;
        for (int n = 0; n < kNeighbours && !meets; ++n) {
          const int32_t slot = s_.neighbour[kNeighbours * int64_t(h) + n];
          meets = slot >= 0 && slot < c.slots && number_[slot] >= 0;
        }
        if (meets) homes_[color].push_back(h);
      }
    }
    return true;
  }

  // Row of every node of the window of home h, -1 where it takes no part.
  struct Window {
    int32_t row[kWindowNodes];
  };
  Window window(int64_t h) const {
    Window w;
    for (int i = 0, at = 0; i < kWindowEdge; ++i)
      for (int j = 0; j < kWindowEdge; ++j)
        for (int k = 0; k < kWindowEdge; ++k, ++at) {
          const int block = (window_block(i) * 3 + window_block(j)) * 3 + window_block(k);
          const int32_t slot = s_.neighbour[kNeighbours * h + block];
          const int32_t n = slot >= 0 && slot < s_.clock->slots ? number_[slot] : -1;
          const int local = local_index(window_local(i), window_local(j), window_local(k));
          w.row[at] = n >= 0 ? n * kBlockNodes + local : -1;
        }
    return w;
  }
  // f(node of the window, weight of x and y, weights of z) for the nine rows of nodes of particle
  // p.
  template <typename F>
  void for_rows(int64_t p, const F& f) const {
    const Stencil<T> stencil = stencil_at(s_.offset + 3 * p);
    const int first = window_node(s_.meta[p]);
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j)
        f(first + (i * kWindowEdge + j) * kWindowEdge, stencil.w[0][i] * stencil.w[1][j],
          stencil.w[2]);
  }

  using Sums = double __attribute__((vector_size(8 * kDamageSums)));

  void scatter() {
    nodes_.assign(slots_.size() * kBlockNodes, Sums{});
    for (const std::vector<int32_t>& homes : homes_)
      parallel_for(static_cast<int64_t>(homes.size()), 1, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; ++i) {
          Sums sums[kWindowNodes] = {};
          for_particles(homes[i], [&](int64_t p) {
            const uint32_t row = s_.row_of(s_.meta[p]);
            if (s_.law[row] != kPhaseField) return;
            double of[kDamageSums];
            damage_given(s_.rows + int64_t(row) * kRowColumns, s_.alpha[p], s_.peak[p], s_.inv_dx,
                         of);
            const Sums given{of[0], of[1], of[2], of[3]};
            for_rows(p, [&](int at, T across, const T* along) {
              const Sums part = double(across) * given;
              for (int k = 0; k < 3; ++k) sums[at + k] += double(along[k]) * part;
            });
          });
          const Window nodes = window(homes[i]);
          for (int n = 0; n < kWindowNodes; ++n)
            if (nodes.row[n] >= 0) nodes_[nodes.row[n]] += sums[n];
        }
      });
  }

  // Edges towards the six neighbours of every node, the right side, and the first guess.
  void prepare() {
    const int64_t count = static_cast<int64_t>(slots_.size());
    edge_.assign(nodes_.size(), Edge{});
    field_.assign(nodes_.size(), 0.0);
    parallel_for(count, 1, [&](int64_t begin, int64_t end) {
      for (int64_t b = begin; b < end; ++b) {
        const int32_t* coord = s_.slot_coord + 4 * int64_t(slots_[b]);
        int32_t face[6];  // slots beyond the faces
        for (int f = 0; f < 6; ++f) face[f] = slot_around(coord, face_block(f));
        for (int local = 0; local < kBlockNodes; ++local) {
          const int64_t n = b * kBlockNodes + local;
          const Sums& node = nodes_[n];
          Edge& e = edge_[n];
          const double sums[kDamageSums] = {node[0], node[1], node[2], node[3]};
          const DamageNode now = damage_node(sums, at2_, empty_, [&](int f) {
            bool inside;
            const int there = face_node(local, f, inside);
            const int32_t slot = inside ? slots_[b] : face[f];
            if (slot < 0) return 0.0;
            if (number_[slot] < 0) return node[kStiffSum];
            const int64_t m = int64_t(number_[slot]) * kBlockNodes + there;
            if (!(nodes_[m][kVolumeSum] > empty_)) return 0.0;
            e.near[f] = static_cast<int32_t>(m);
            return e.weight[f] = edge_weight(node[kStiffSum], nodes_[m][kStiffSum]);
          });
          field_[n] = now.value;
          e.right = now.right;
          e.inverse = now.inverse;
        }
      }
    });
  }

  void relax() {
    const int64_t count = static_cast<int64_t>(slots_.size());
    for (int sweep = 0; sweep < 2 * kSweeps; ++sweep)
      parallel_for(count, 8, [&](int64_t begin, int64_t end) {
        for (int64_t b = begin; b < end; ++b)
          for (int local = 0; local < kBlockNodes; ++local) {
            if (node_colour(local) != sweep % 2) continue;
            const Edge& e = edge_[b * kBlockNodes + local];
            if (e.inverse == 0.0) continue;
            double sum = e.right;
            for (int f = 0; f < 6; ++f) sum += e.weight[f] * field_[e.near[f]];
            double& d = field_[b * kBlockNodes + local];
            d = relaxed(d, sum, e.inverse);
          }
      });
  }

  void gather() {
    for (const std::vector<int32_t>& homes : homes_)
      parallel_for(static_cast<int64_t>(homes.size()), 1, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; ++i) {
          const Window nodes = window(homes[i]);
          T field[kWindowNodes], most(0);
          for (int n = 0; n < kWindowNodes; ++n) {
            field[n] = nodes.row[n] >= 0 ? T(field_[nodes.row[n]]) : T(0);
            most = std::max(most, field[n]);
          }
          if (most == T(0)) continue;  // no point gets more than it has
          for_particles(homes[i], [&](int64_t p) {
            if (!is_phase(p)) return;
            T found(0);
            for_rows(p, [&](int at, T across, const T* along) {
              const T* f = field + at;
              found += across * (along[0] * f[0] + along[1] * f[1] + along[2] * f[2]);
            });
            s_.peak[p] = peak_after(s_.peak[p], found);
          });
        }
      });
  }

  struct Edge {
    double weight[6] = {}, right = 0.0, inverse = 0.0;
    int32_t near[6] = {};
  };

  const SolverView<T>& s_;
  bool at2_ = false;
  double empty_ = 0.0;
  T active_;  // alpha from which a point takes part
  std::vector<uint64_t> keys_;
  std::vector<int32_t> colors_[kColors], homes_[kColors];  // homes by colour; those that take part
  std::vector<int32_t> number_;                            // [slots] row of an active slot, or -1
  std::vector<int32_t> slots_;                             // active slots
  std::vector<Sums> nodes_;
  std::vector<Edge> edge_;
  std::vector<double> field_;
};

}  // namespace gsf::cpu
