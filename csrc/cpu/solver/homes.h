// Particles of the resident solver on the CPU, home by home: to the nodes of its window and back.
#pragma once

#include <bit>

#include "cpu/contact/points.h"
#include "cpu/solver/surface.h"
#include "cpu/solver/update.h"

namespace gsf::cpu {

constexpr int64_t kHomeGrain = 4;
constexpr int kColors = 8;  // windows of homes two blocks apart share no node

// Cells of a window in order, by the nine bits of l in a meta word, and the l of each axis as one
// bit of a byte.
constexpr int kCells = (kLastCell + 1) * (kLastCell + 1) * (kLastCell + 1);
struct CellTable {
  uint8_t at[512];
  uint32_t places[512];
  constexpr CellTable() : at{}, places{} {
    for (uint32_t word = 0; word < 512; ++word) {
      int cell = 0;
      for (int axis = 0; axis < 3; ++axis) {
        const int stored = static_cast<int>(word >> (3 * axis) & 7u);
        const int l = stored < kLastCell ? stored : kLastCell;
        cell = cell * (kLastCell + 1) + l;
        places[word] |= 1u << (8 * axis + l);
      }
      at[word] = static_cast<uint8_t>(cell);
    }
  }
};
constexpr CellTable kCellOf;

// Nodes [lo, hi) of a window that a home's particles touch.
struct Box {
  int8_t lo[3], hi[3];
};

template <typename T>
class HomePass {
 public:
  HomePass(const SolverView<T>& s, const ContactPlan<T>& contact, SurfacePlan<T>& surface,
           TouchPlan<T>& touch)
      : s_(s), contact_(contact), surface_(surface), touch_(touch) {}

  void plan() {
    const HomeList<T>& list = s_.homes();
    for (auto& color : colors_) color.clear();
    for (int64_t h = 0; h < s_.clock->homes; ++h) {
      const int32_t* b = list.coord + 4 * h;
      colors_[(b[0] & 1) * 4 + (b[1] & 1) * 2 + (b[2] & 1)].push_back(static_cast<int32_t>(h));
    }
    box_.assign(s_.clock->homes, Box{});
  }

  // Adds the particles of the homes of one colour to the sums of their nodes and marks the slots;
  // all colours one after the other. A node gets at most one addend from each, so that ranks which
  // share nodes can agree in between. Particles of homes with nodes that have no slot count as
  // lost.
  Counts to_nodes(int color, std::vector<uint8_t>& touched) {
    const std::vector<int32_t>& homes = colors_[color];
    return parallel_counts(static_cast<int64_t>(homes.size()), kHomeGrain,
                           [&](int64_t begin, int64_t end, Counts& counts) {
                             for (int64_t i = begin; i < end; ++i)
                               if (!home_to_nodes(homes[i], touched)) ++counts.lost;
                           });
  }

  // Updates every particle from the velocities of its nodes.
  Counts from_nodes(int laws) const {
    if (laws == kElasticOnly) return from_nodes<kElasticOnly>();
    if (laws == kMoreLaws) return from_nodes_more();
    if (with_springs(laws)) return from_nodes_viscous(laws);
    return laws == kBrittle ? from_nodes<kBrittle>() : from_nodes<kAnyLaw>();
  }

  template <int kLaws, bool kKeeps = false>
  Counts from_nodes() const {
    return s_.deformation != nullptr ? from_nodes<kLaws, true, kKeeps>()
                                     : from_nodes<kLaws, false, kKeeps>();
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
  // f(tile index, node index in `sums`, nodes in a row) for the nodes of the box of home h. False
  // when a part of it has no slot.
  template <typename F>
  bool for_each_run(int64_t h, const F& f) const {
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
    const auto cell = [&](int64_t p) { return kCellOf.at[s_.meta[p] & 511u]; };
    int32_t next[kCells + 1] = {};
    uint32_t places = 0;
    for (int64_t p = r.begin; p < r.end; ++p) {
      ++next[cell(p) + 1];
      places |= kCellOf.places[s_.meta[p] & 511u];
    }
    for (int c = 0; c < kCells; ++c) next[c + 1] += next[c];
    for (int64_t p = r.begin; p < r.end; ++p)
      s_.entry[r.begin + next[cell(p)]++] = static_cast<int32_t>(p);
    for (int axis = 0; axis < 3; ++axis) {
      const uint32_t mine = places >> (8 * axis) & 255u;
      box_[h].lo[axis] = static_cast<int8_t>(std::countr_zero(mine));
      box_[h].hi[axis] = static_cast<int8_t>(std::bit_width(mine) + 2);  // last cell + 3
    }
  }

  // Sums of one home's particles, added to the slots. Returns whether every node had one.
  bool home_to_nodes(int64_t h, std::vector<uint8_t>& touched) {
    const Range r = range(h);
    if (r.begin == r.end) return true;
    sort_home(h, r);
    const uint32_t contact = contact_.around_home(h), readers = ContactPlan<T>::readers(contact);
    std::vector<T> pushes;
    const bool pushed =
        surface_.near(h) && surface_.pushes(h, s_.entry + r.begin, r.end - r.begin, pushes);
    const bool met = touch_.pushes(h);
    Lanes<double> tile[kWindowNodes];
    Lanes<T> moment[kWindowNodes], push[kWindowNodes], press[kWindowNodes];
    for_each_run(h, [&](int t, int64_t, int run) {
      std::fill(tile + t, tile + t + run, Lanes<double>{});
      if (contact != 0) std::fill(moment + t, moment + t + run, Lanes<T>{});
      if (pushed) std::fill(push + t, push + t + run, Lanes<T>{});
      if (met) std::fill(press + t, press + t + run, Lanes<T>{});
    });
    for (int64_t at = r.begin; at < r.end; at += Pack<T>::kLanes) {
      const Packet<T> packet(s_, s_.entry + at, r.end - at);
      PacketMomentum<T> given(s_, packet);
      const int used = static_cast<int>(std::min<int64_t>(r.end - at, Pack<T>::kLanes));
      const T* impulse = pushed ? pushes.data() + 4 * (at - r.begin) : nullptr;
      for (int lane = 0; pushed && lane < used; ++lane) given.push(lane, impulse + 4 * lane);
      T pressed[4 * Pack<T>::kLanes];
      for (int lane = 0; met && lane < used; ++lane) {
        std::copy_n(touch_.given(packet.index[lane]), 4, pressed + 4 * lane);
        given.push(lane, pressed + 4 * lane);
      }
      for (int lane = 0; lane < used;) {
        const int end = std::min(packet.run(lane), used);
        const int base = window_node(packet.meta[lane]);
        given.scatter(lane, end, tile + base);
        if (contact != 0 && ContactPlan<T>::reads(readers, packet.meta[lane]))
          given.scatter_moment(lane, end, moment + base);
        if (pushed &&
            std::any_of(impulse + 4 * lane, impulse + 4 * end, [](T v) { return v != T(0); }))
          given.scatter_four(lane, end, impulse, push + base);
        if (met &&
            std::any_of(pressed + 4 * lane, pressed + 4 * end, [](T v) { return v != T(0); }))
          given.scatter_four(lane, end, pressed, press + base);
        lane = end;
      }
    }
    double* sums = static_cast<double*>(s_.sums);
    T* moments = static_cast<T*>(s_.moments);
    const uint8_t mark =
        static_cast<uint8_t>(kTouchedSums | (contact != 0 ? kTouchedMoments : 0) |
                             (pushed ? kTouchedPush : 0) | (met ? kTouchedPoints : 0));
    return for_each_run(h, [&](int t, int64_t node, int run) {
      std::atomic_ref<uint8_t> marks(touched[node / kBlockNodes]);  // mostly there already
      if ((marks.load(std::memory_order_relaxed) & mark) != mark)
        marks.fetch_or(mark, std::memory_order_relaxed);
      for (int n = 0; n < run; ++n) {
        double* sum = sums + 4 * (node + n);
        const Quad<double> more = load_quad(sum) + tile[t + n];
        std::memcpy(sum, &more, sizeof more);
      }
      for (int n = 0; pushed && n < run; ++n)
        for (int c = 0; c < 4; ++c) surface_.sums()[4 * (node + n) + c] += push[t + n][c];
      for (int n = 0; met && n < run; ++n)
        for (int c = 0; c < 4; ++c) touch_.sums()[4 * (node + n) + c] += press[t + n][c];
      if (contact == 0) return;
      for (int n = 0; n < run; ++n)
        for (int c = 0; c < kContactMoments; ++c)
          moments[kContactMoments * (node + n) + c] += moment[t + n][c];
    });
  }

  template <int kLaws, bool kTrack, bool kKeeps>
  void home_from_nodes(int64_t h, T dt, T dt_next, Counts& counts) const {
    const Range r = range(h);
    if (r.begin == r.end) return;
    Lanes<T> tile[kWindowNodes];
    for_each_run(h, [&](int t, int64_t node, int run) {
      const T* in = s_.node_velocity + 4 * node;
      for (int n = 0; n < run; ++n) tile[t + n] = load_quad(in + 4 * n);
    });
    const uint32_t reach = reach_of_row(s_.neighbour + kNeighbours * h);
    PacketLargest<T> largest;
    Chunk chunk;
    for (int64_t at = r.begin; at < r.end; at += kChunk) {
      chunk.gather(s_, at, std::min(at + kChunk, r.end), tile);
      for (int64_t first = at; first < std::min(at + kChunk, r.end); first += kLanes) {
        const Packet<T> packet(s_, s_.entry + first, r.end - first);
        Pack<T> offset[3];
        const PacketGathered<T> gathered = chunk.gathered(first - at, offset);
        finish_packet<T, kLaws, kTrack, kKeeps>(s_, packet, reach, offset, gathered, dt, dt_next,
                                                largest, counts);
      }
    }
    largest.give(counts.largest);
  }

  // What a stretch of a home's particles gathers: cell by cell, so that each cell is read once,
  // then handed out in full packets.
  static constexpr int kLanes = Pack<T>::kLanes;
  static constexpr int64_t kChunk = 256;
  struct Chunk {
    static constexpr int kRows = 15;  // offset, value, first
    alignas(32) T row[kRows][kChunk + kLanes] = {};

    void gather(const SolverView<T>& s, int64_t begin, int64_t end, const Lanes<T>* tile) {
      for (int64_t at = begin; at < end; at += kLanes) {
        Pack<T> offset[3];
        Packet<T>(s, s.entry + at, end - at).load3(s.offset, offset);
        for (int c = 0; c < 3; ++c) store_pack(row[c] + (at - begin), offset[c]);
      }
      for (int64_t at = begin; at < end;) {
        const uint32_t cell = s.meta[s.entry[at]] & 511u;
        int64_t last = at + 1;
        while (last < end && last < at + kLanes && (s.meta[s.entry[last]] & 511u) == cell) ++last;
        Pack<T> offset[3];
        for (int c = 0; c < 3; ++c) offset[c] = load_pack(row[c] + (at - begin));
        const PacketGathered<T> g = packet_gather(offset, tile + window_node(cell));
        // Lanes beyond `last` are written again by the next cell.
        for (int c = 0; c < 3; ++c) store_pack(row[3 + c] + (at - begin), g.value[c]);
        for (int c = 0; c < 9; ++c) store_pack(row[6 + c] + (at - begin), g.first.m[c]);
        at = last;
      }
    }
    PacketGathered<T> gathered(int64_t at, Pack<T>* offset) const {
      PacketGathered<T> g;
      for (int c = 0; c < 3; ++c) offset[c] = load_pack(row[c] + at);
      for (int c = 0; c < 3; ++c) g.value[c] = load_pack(row[3 + c] + at);
      for (int c = 0; c < 9; ++c) g.first.m[c] = load_pack(row[6 + c] + at);
      return g;
    }
  };

  template <int kLaws, bool kTrack, bool kKeeps>
  Counts from_nodes() const {
    const SolverClock& c = *s_.clock;
    const T dt = static_cast<T>(c.dt), dt_next = static_cast<T>(c.dt_next);
    return parallel_counts(c.homes, kHomeGrain, [&](int64_t begin, int64_t end, Counts& counts) {
      for (int64_t h = begin; h < end; ++h)
        home_from_nodes<kLaws, kTrack, kKeeps>(h, dt, dt_next, counts);
    });
  }

  // In solver_more.cpp, so that the loops here stay as they are compiled.
  Counts from_nodes_more() const;
  Counts from_nodes_viscous(int laws) const;  // in solver_viscous.cpp
  friend class FlipPass<T>;                   // in cpu/mpm/flip.cpp, likewise
  friend class DamagePass<T>;                 // in cpu/solver/damage.h

  const SolverView<T>& s_;
  const ContactPlan<T>& contact_;
  SurfacePlan<T>& surface_;
  TouchPlan<T>& touch_;
  std::vector<int32_t> colors_[kColors];  // homes, those of one colour at once
  std::vector<Box> box_;                  // [homes]
};

}  // namespace gsf::cpu
