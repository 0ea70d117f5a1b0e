// The resident solver on the CPU: particles of a home to its window and back, nodes, the loop over
// steps. Every sum is taken in an order that depends on neither the number of threads nor the order
// in which the particles were loaded.
#include "host/solver.h"

#include <algorithm>
#include <atomic>

#include "core/solver_clock.h"
#include "core/solver_node.h"
#include "cpu/solver_cpu.h"
#include "cpu/solver_packet.h"

namespace gsf::cpu {
namespace {

constexpr int64_t kParticleGrain = 2048;
constexpr int64_t kHomeGrain = 4;
constexpr int64_t kSiteChunk = 16;  // sites per ordered partial sum; fixed, so that sums are too
constexpr int kColors = 8;          // windows of homes two blocks apart share no node

// Nodes [lo, hi) of a window that a home's particles touch.
struct Box {
  int8_t lo[3], hi[3];
};

struct Counts {
  int64_t plastic = 0, guarded = 0, inverted = 0, invalid = 0, lost = 0;
  bool leaves = false;
  Largest largest{};

  void add(const StepFlags& f) {
    plastic += f.plastic;
    guarded += f.guarded;
    inverted += f.inverted;
    invalid += f.invalid;
    lost += f.lost;
    leaves = leaves || f.leaves;
  }
  void add(const Counts& o) {
    plastic += o.plastic;
    guarded += o.guarded;
    inverted += o.inverted;
    invalid += o.invalid;
    lost += o.lost;
    leaves = leaves || o.leaves;
    largest.speed2 = larger(o.largest.speed2, largest.speed2);
    largest.wave2 = larger(o.largest.wave2, largest.wave2);
    largest.gradient2 = larger(o.largest.gradient2, largest.gradient2);
    largest.bound = larger(o.largest.bound, largest.bound);
  }
};

void give_largest(const Largest& l, SolverClock& c) {
  c.speed = bits_of(std::sqrt(l.speed2));
  c.wave = bits_of(std::sqrt(l.wave2));
  c.gradient = bits_of(std::sqrt(l.gradient2));
}

template <typename T>
class Stepper {
 public:
  Stepper(const SolverView<T>& s, int laws) : s_(s), laws_(laws) {}

  // Everything that follows from the blocks; again after each build.
  void plan() {
    const SolverClock& c = *s_.clock;
    STD_TORCH_CHECK(c.homes >= 0 && c.homes <= s_.home_capacity && c.slots >= 0 &&
                        c.slots <= s_.slot_capacity && c.sites >= 0 && c.sites <= c.slots,
                    "solver: the clock counts more blocks than there is room for");
    const HomeList<T>& list = s_.homes();
    for (auto& color : colors_) color.clear();
    for (int64_t h = 0; h < c.homes; ++h) {
      const int32_t* b = list.coord + 4 * h;
      colors_[(b[0] & 1) * 4 + (b[1] & 1) * 2 + (b[2] & 1)].push_back(static_cast<int32_t>(h));
    }
    box_.assign(c.homes, Box{});
    touched_.assign(c.slots, 0);
    const int64_t chunks = (c.sites + kSiteChunk - 1) / kSiteChunk;
    impulse_.assign(chunks * s_.collider_count * 3, 0.0);
    contacts_.assign(chunks, 0);
  }

  void step() {
    SolverClock& c = *s_.clock;
    Counts all = to_nodes();
    nodes(static_cast<T>(c.dt));
    all.add(laws_ == kElasticOnly
                ? from_nodes<kElasticOnly>()
                : (laws_ == kBrittle ? from_nodes<kBrittle>() : from_nodes<kAnyLaw>()));
    c.plastic += all.plastic;
    c.guarded += all.guarded;
    c.inverted += all.inverted;
    c.invalid += all.invalid;
    c.lost += all.lost;
    if (all.leaves) c.rebuild = 1;
    give_largest(all.largest, c);
    end_step(c, double(s_.dx), s_.count);
  }

 private:
  // Particles of home h, clamped to those there are.
  struct Range {
    int64_t begin, end;
  };
  Range range(int64_t h) const {
    const HomeList<T>& list = s_.homes();
    const int64_t begin = std::clamp<int64_t>(list.start[h], 0, s_.count);
    return {begin, begin + std::clamp<int64_t>(list.count[h], 0, s_.count - begin)};
  }
  int32_t slot(int64_t h, int i, int j, int k) const {
    const int32_t n = s_.neighbour[kNeighbours * h + (window_block(i) * 3 + window_block(j)) * 3 +
                                   window_block(k)];
    return n < s_.clock->slots ? n : -1;
  }
  int64_t row(uint32_t meta) const {
    return meta_row(meta) < uint64_t(s_.row_count) ? meta_row(meta) : 0;
  }

  // f(tile index, node index in `sums`, nodes in a row) for the nodes of the box of home h. False
  // when a part of it has no slot.
  template <typename F>
  bool for_each_run(int64_t h, const F& f) {
    const Box& box = box_[h];
    bool whole = true;
    for (int i = box.lo[0]; i < box.hi[0]; ++i)
      for (int j = box.lo[1]; j < box.hi[1]; ++j)
        for (int k = box.lo[2]; k < box.hi[2];) {
          const int local = window_local(k);
          const int run = std::min(kBlockEdge - local, box.hi[2] - k);
          const int32_t b = slot(h, i, j, k);
          whole = whole && b >= 0;
          if (b >= 0)
            f((i * kWindowEdge + j) * kWindowEdge + k,
              int64_t(b) * kBlockNodes + local_index(window_local(i), window_local(j), local), run);
          k += run;
        }
    return whole;
  }

  // Box of home h, and its particles in the order of their cells (stable) in `entry`.
  void sort_home(int64_t h, const Range& r) {
    constexpr int kCells = (kLastCell + 1) * (kLastCell + 1) * (kLastCell + 1);
    const auto cell = [&](int64_t p) {
      int at = 0;
      for (int axis = 0; axis < 3; ++axis)
        at = at * (kLastCell + 1) + std::min(meta_cell(s_.meta[p], axis), kLastCell);
      return at;
    };
    int32_t next[kCells + 1] = {};
    for (int64_t p = r.begin; p < r.end; ++p) ++next[cell(p) + 1];
    int lo[3] = {kLastCell, kLastCell, kLastCell}, hi[3] = {0, 0, 0};
    for (int c = 0; c < kCells; ++c) {
      if (next[c + 1] > 0) {
        const int l[3] = {c / 36, c / 6 % 6, c % 6};
        for (int axis = 0; axis < 3; ++axis) {
          lo[axis] = std::min(lo[axis], l[axis]);
          hi[axis] = std::max(hi[axis], l[axis] + 3);
        }
      }
      next[c + 1] += next[c];
    }
    for (int64_t p = r.begin; p < r.end; ++p)
      s_.entry[r.begin + next[cell(p)]++] = static_cast<int32_t>(p);
    for (int axis = 0; axis < 3; ++axis) {
      box_[h].lo[axis] = static_cast<int8_t>(lo[axis]);
      box_[h].hi[axis] = static_cast<int8_t>(hi[axis]);
    }
  }

  bool shared(int64_t h) const {
    if (s_.moments == nullptr) return false;
    for (int n = 0; n < kNeighbours; ++n) {
      const int32_t b = s_.neighbour[kNeighbours * h + n];
      if (b >= 0 && b < s_.clock->slots && s_.slot_shared[b] != 0) return true;
    }
    return false;
  }

  // Sums of one home's particles, added to the slots. Returns whether every node had one.
  bool home_to_nodes(int64_t h) {
    const Range r = range(h);
    if (r.begin == r.end) return true;
    sort_home(h, r);
    const bool contact = shared(h);
    Lanes<T> tile[kWindowNodes];
    Lanes<T> moment[kWindowNodes];
    for_each_run(h, [&](int t, int64_t, int run) {
      for (int n = t; n < t + run; ++n) tile[n] = Lanes<T>{};
      if (contact)
        for (int n = t; n < t + run; ++n) moment[n] = Lanes<T>{};
    });
    for (int64_t at = r.begin; at < r.end; at += Pack<T>::kLanes) {
      const Packet<T> packet(s_, s_.entry + at, r.end - at);
      const PacketMomentum<T> given(s_, packet, packet.same_rows());
      const int used = static_cast<int>(std::min<int64_t>(r.end - at, Pack<T>::kLanes));
      for (int lane = 0; lane < used;) {
        const int end = std::min(packet.run(lane), used);
        given.scatter(lane, end, tile + window_node(packet.meta[lane]));
        lane = end;
      }
    }
    if (contact)
      for (int64_t at = r.begin; at < r.end; ++at) {
        const int64_t p = s_.entry[at];
        const T mass = s_.rows[row(s_.meta[p]) * kRowColumns + kMassColumn];
        scatter_moments(stencil_at(s_.offset + 3 * p), mass, moment + window_node(s_.meta[p]),
                        kWindowEdge);
      }
    T* sums = static_cast<T*>(s_.sums);
    T* moments = static_cast<T*>(s_.moments);
    return for_each_run(h, [&](int t, int64_t node, int run) {
      std::atomic_ref<uint8_t>(touched_[node / kBlockNodes]).store(1, std::memory_order_relaxed);
      for (int n = 0; n < run; ++n)
        for (int c = 0; c < 4; ++c) sums[4 * (node + n) + c] += tile[t + n][c];
      if (!contact) return;
      for (int n = 0; n < run; ++n)
        for (int c = 0; c < kContactMoments; ++c)
          moments[kContactMoments * (node + n) + c] += moment[t + n][c];
    });
  }

  Counts to_nodes() {
    std::fill(touched_.begin(), touched_.end(), uint8_t(0));
    std::atomic<int64_t> uncovered{0};
    for (const std::vector<int32_t>& homes : colors_)
      parallel_for(static_cast<int64_t>(homes.size()), kHomeGrain, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; ++i)
          if (!home_to_nodes(homes[i])) ++uncovered;
      });
    Counts counts;
    counts.lost = uncovered;
    return counts;
  }

  // One node of a site whose slots are `slots`: velocities, contact, colliders.
  int64_t node(const int32_t* slots, int fields, int local, T dt, double* impulse) {
    T* sums = static_cast<T*>(s_.sums);
    T* moments = static_cast<T*>(s_.moments);
    NodeSums<T> sum[kSiteFields];
    Vec3<T> velocity[kSiteFields];
    bool heavy[kSiteFields];
    int present = 0;
    for (int a = 0; a < fields; ++a) {
      const int64_t n = int64_t(slots[a]) * kBlockNodes + local;
      sum[a].mass = double(sums[4 * n + 3]);
      for (int i = 0; i < 3; ++i) sum[a].momentum[i] = double(sums[4 * n + i]);
      heavy[a] = node_velocity(s_, sum[a], dt, velocity[a]);
      present += heavy[a] ? 1 : 0;
      for (int i = 0; i < 4; ++i) sums[4 * n + i] = T(0);
      if (fields < 2 || moments == nullptr) continue;
      T* m = moments + kContactMoments * n;
      for (int i = 0; i < kContactMoments; ++i) {
        sum[a].moments[i] = m[i];
        m[i] = T(0);
      }
    }
    int64_t contacts = 0;
    if (present > 1 && moments != nullptr)
      contacts = node_contact(s_, fields, heavy, OwnNode<T>{sum}, velocity) > 0 ? 1 : 0;
    if (s_.collider_count > 0 && present > 0) {
      const int32_t* b = s_.slot_coord + 4 * int64_t(slots[0]);
      const Vec3<T> x{(T(b[0]) * kBlockEdge + T(local / 16)) * s_.dx,
                      (T(b[1]) * kBlockEdge + T(local / 4 % 4)) * s_.dx,
                      (T(b[2]) * kBlockEdge + T(local % 4)) * s_.dx};
      for (int64_t k = 0; k < s_.collider_count; ++k)
        for (int a = 0; a < fields; ++a)
          if (heavy[a]) node_collide(s_, k, x, sum[a].mass, velocity[a], impulse + 3 * k);
    }
    for (int a = 0; a < fields; ++a) {
      T* out = s_.node_velocity + 4 * (int64_t(slots[a]) * kBlockNodes + local);
      for (int i = 0; i < 3; ++i) out[i] = velocity[a][i];
      out[3] = T(0);
    }
    return contacts;
  }

  // All nodes that got anything this step.
  void nodes(T dt) {
    SolverClock& c = *s_.clock;
    const int64_t chunks = static_cast<int64_t>(contacts_.size()), terms = 3 * s_.collider_count;
    parallel_for(chunks, 1, [&](int64_t begin, int64_t end) {
      for (int64_t chunk = begin; chunk < end; ++chunk) {
        double* impulse = impulse_.data() + chunk * terms;
        std::fill(impulse, impulse + terms, 0.0);
        contacts_[chunk] = 0;
        const int64_t last = std::min((chunk + 1) * kSiteChunk, c.sites);
        for (int64_t site = chunk * kSiteChunk; site < last; ++site) {
          int32_t slots[kSiteFields];
          int fields = 0;
          for (int i = 0; i < kSiteFields; ++i) {
            const int32_t b = s_.site_slots[kSiteFields * site + i];
            if (b >= 0 && b < c.slots && touched_[b] != 0) slots[fields++] = b;
          }
          if (fields == 0) continue;
          for (int local = 0; local < kBlockNodes; ++local)
            contacts_[chunk] += node(slots, fields, local, dt, impulse);
        }
      }
    });
    for (int64_t chunk = 0; chunk < chunks; ++chunk) {
      for (int64_t i = 0; i < terms; ++i) s_.impulse[i] += impulse_[chunk * terms + i];
      c.touched += contacts_[chunk];
    }
  }

  template <int kLaws, bool kTrack>
  void home_from_nodes(int64_t h, T dt, T dt_next, Counts& counts) {
    const Range r = range(h);
    if (r.begin == r.end) return;
    Lanes<T> tile[kWindowNodes];
    for_each_run(h, [&](int t, int64_t node, int run) {
      const T* in = s_.node_velocity + 4 * node;
      for (int n = 0; n < run; ++n)
        tile[t + n] = Lanes<T>{in[4 * n], in[4 * n + 1], in[4 * n + 2], T(0)};
    });
    const uint32_t reach = reach_of_row(s_.neighbour + kNeighbours * h);
    PacketLargest<T> largest;
    for (int64_t at = r.begin; at < r.end; at += Pack<T>::kLanes) {
      const Packet<T> packet(s_, s_.entry + at, r.end - at);
      Pack<T> offset[3], value[3];
      Mat3<Pack<T>> first;
      packet.load3(s_, s_.offset, offset);
      packet_gather_tile(packet, offset, tile, value, first);
      finish_packet<T, kLaws, kTrack>(s_, packet, reach, offset, value, first, dt, dt_next, largest,
                                      counts);
    }
    largest.give(counts.largest);
  }

  template <int kLaws>
  Counts from_nodes() {
    return s_.deformation != nullptr ? from_nodes<kLaws, true>() : from_nodes<kLaws, false>();
  }
  template <int kLaws, bool kTrack>
  Counts from_nodes() {
    const SolverClock& c = *s_.clock;
    const T dt = static_cast<T>(c.dt), dt_next = static_cast<T>(c.dt_next);
    Counts all;
    std::atomic_flag busy;
    parallel_for(c.homes, kHomeGrain, [&](int64_t begin, int64_t end) {
      Counts mine;
      for (int64_t h = begin; h < end; ++h) home_from_nodes<kLaws, kTrack>(h, dt, dt_next, mine);
      // Counts and maxima do not depend on the order in which they meet.
      while (busy.test_and_set(std::memory_order_acquire)) busy.wait(true);
      all.add(mine);
      busy.clear(std::memory_order_release);
      busy.notify_one();
    });
    return all;
  }

  const SolverView<T>& s_;
  const int laws_;
  std::vector<int32_t> colors_[kColors];  // homes, those of one colour at once
  std::vector<Box> box_;                  // [homes]
  std::vector<uint8_t> touched_;          // [slots] whether any home adds to it in this step
  std::vector<double> impulse_;           // [chunks, colliders, 3]
  std::vector<int64_t> contacts_;         // [chunks] nodes at which fields touched
};

template <typename T>
void prime_particles(const SolverView<T>& s, bool measure) {
  SolverClock& c = *s.clock;
  const T dt = static_cast<T>(c.dt);
  Counts all;
  std::atomic_flag busy;
  parallel_for(s.count, kParticleGrain, [&](int64_t begin, int64_t end) {
    Counts mine;
    for (int64_t p = begin; p < end; ++p) prime_particle(s, p, measure, dt, mine.largest);
    while (busy.test_and_set(std::memory_order_acquire)) busy.wait(true);
    all.add(mine);
    busy.clear(std::memory_order_release);
    busy.notify_one();
  });
  if (measure)
    give_largest(all.largest, c);
  else
    c.bound = bits_of(all.largest.bound);
}

struct Cpu {
  struct Scope {
    explicit Scope(const Tensor&) {}
  };

  template <typename T>
  static void prime(const SolverView<T>& s, int, const Scope&) {
    SolverClock& c = *s.clock;
    if (s.row_count == 0) return;
    prime_particles(s, true);
    start_clock(c, double(s.dx));
    if (c.done != 0 || c.reason != kFine) return;
    prime_particles(s, false);
    choose_unit(c);
  }

  template <typename T>
  static void run(const SolverView<T>& s, int laws, int64_t rounds, int64_t steps, const Scope&) {
    SolverClock& c = *s.clock;
    if (s.row_count == 0) return;
    Stepper<T> stepper(s, laws);
    if (may_step(c)) stepper.plan();
    for (int64_t i = 0; i < rounds * steps; ++i) {
      if (may_build(c)) {
        solver_build(s);
        if (may_step(c)) stepper.plan();
      }
      if (!may_step(c)) return;
      stepper.step();
    }
  }
};

}  // namespace
}  // namespace gsf::cpu

STABLE_TORCH_LIBRARY_IMPL(gsfluent, CPU, m) { gsf::SolverOps<gsf::cpu::Cpu>::register_all(m); }
