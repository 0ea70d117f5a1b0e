// Nodes of the resident solver on the CPU: sums to velocities, contact, colliders, site by site.
#pragma once

#include "core/solver/points.h"
#include "cpu/contact/points.h"
#include "cpu/solver/surface.h"

namespace gsf::cpu {

constexpr int64_t kSlotGrain = 64;
constexpr int64_t kSiteChunk = 16;  // sites per ordered partial sum; fixed, so that sums are too
constexpr int64_t kNearColliders = 64;  // with more, every site looks at all of them

template <typename T>
class NodePass {
 public:
  NodePass(const SolverView<T>& s, const ContactPlan<T>& contact, SurfacePlan<T>& surface,
           TouchPlan<T>& touch)
      : s_(s), contact_(contact), surface_(surface), touch_(touch) {}

  void plan() {
    const int64_t chunks = (s_.clock->sites + kSiteChunk - 1) / kSiteChunk;
    impulse_.assign(chunks * s_.collider_count * kImpulseSums, 0.0);
    contacts_.assign(chunks, 0);
  }

  // All nodes of touched slots; clears their sums and the marks.
  void run(T dt, std::vector<uint8_t>& touched) {
    SolverClock& c = *s_.clock;
    const int64_t chunks = static_cast<int64_t>(contacts_.size()),
                  terms = kImpulseSums * s_.collider_count;
    parallel_for(chunks, 1, [&](int64_t begin, int64_t end) {
      for (int64_t chunk = begin; chunk < end; ++chunk) {
        double* impulse = impulse_.data() + chunk * terms;
        std::fill(impulse, impulse + terms, 0.0);
        contacts_[chunk] = 0;
        const int64_t last = std::min((chunk + 1) * kSiteChunk, c.sites);
        for (int64_t index = chunk * kSiteChunk; index < last; ++index) {
          const Site here = site(index, touched);
          if (here.fields == 0) continue;
          int marks = 0;
          for (int i = 0; i < here.fields; ++i) marks |= touched[here.slots[i]];
          for (int local = 0; local < kBlockNodes; ++local)
            contacts_[chunk] += node(here, local, marks, dt, impulse);
        }
      }
    });
    parallel_for(c.slots, kSlotGrain, [&](int64_t begin, int64_t end) {
      for (int64_t b = begin; b < end; ++b) {
        if (touched[b] & kTouchedSums)
          std::fill_n(static_cast<double*>(s_.sums) + 4 * kBlockNodes * b, 4 * kBlockNodes, 0.0);
        constexpr int64_t kMoments = kBlockNodes * kContactMoments;
        if (touched[b] & kTouchedMoments)
          std::fill_n(static_cast<T*>(s_.moments) + kMoments * b, kMoments, T(0));
        if (touched[b] & kTouchedPush)
          std::fill_n(surface_.sums() + 4 * kBlockNodes * b, 4 * kBlockNodes, T(0));
        if (touched[b] & kTouchedPoints)
          std::fill_n(touch_.sums() + 4 * kBlockNodes * b, 4 * kBlockNodes, T(0));
        touched[b] = 0;
      }
    });
    for (int64_t chunk = 0; chunk < chunks; ++chunk) {
      c.touched += contacts_[chunk];
    }
    for (int64_t k = 0; k < s_.collider_count; ++k) {
      double sums[kImpulseSums] = {};
      for (int64_t chunk = 0; chunk < chunks; ++chunk)
        for (int i = 0; i < kImpulseSums; ++i)
          sums[i] += impulse_[chunk * terms + k * kImpulseSums + i];
      end_collider(s_, k, sums, c.dt);
    }
  }

 private:
  // One site: its slots that got anything in this step, and the colliders that can touch it.
  struct Site {
    int32_t slots[kSiteFields];
    int fields = 0;
    int32_t near[kNearColliders];
    int64_t colliders = 0;

    int32_t collider(int64_t i) const {
      return colliders <= kNearColliders ? near[i] : static_cast<int32_t>(i);
    }
  };
  Site site(int64_t index, const std::vector<uint8_t>& touched) const {
    Site site;
    for (int i = 0; i < kSiteFields; ++i) {
      const int32_t b = s_.site_slots[kSiteFields * index + i];
      if (b >= 0 && b < s_.clock->slots && touched[b] != 0) site.slots[site.fields++] = b;
    }
    if (site.fields == 0 || s_.collider_count == 0) return site;
    if (s_.collider_count > kNearColliders) {
      site.colliders = s_.collider_count;
      return site;
    }
    const Vec3<T> center = node_position(site.slots[0], T(1.5), T(1.5), T(1.5));
    for (int64_t k = 0; k < s_.collider_count; ++k) {
      const T* row = s_.colliders + k * kColliderColumns;
      if (!collider_valid(row, s_.sdf_count)) continue;
      // Nodes lie within sqrt(27) / 2 of the centre; what sweeps may come from anywhere.
      const T reach = surface_.any() && collider_springs(row) ? T(2.8 - kSpringNode) : T(2.8);
      const bool far = collider_clearance(row, s_.sdf, center) > reach * s_.dx;
      if (!far || row[kSweep] != T(0)) site.near[site.colliders++] = static_cast<int32_t>(k);
    }
    return site;
  }
  Vec3<T> node_position(int64_t slot, T i, T j, T k) const {
    const int32_t* b = s_.slot_coord + 4 * slot;
    return {(T(b[0]) * kBlockEdge + i) * s_.dx, (T(b[1]) * kBlockEdge + j) * s_.dx,
            (T(b[2]) * kBlockEdge + k) * s_.dx};
  }

  // One node of a site: velocities, contact, colliders. Returns whether fields touched.
  int64_t node(const Site& site, int local, int marks, T dt, double* impulse) {
    const double* sums = static_cast<const double*>(s_.sums);
    const int fields = site.fields;
    double mass[kSiteFields];
    Vec3<T> velocity[kSiteFields];
    bool heavy[kSiteFields];
    int present = 0;
    for (int a = 0; a < fields; ++a) {
      const double* n = sums + 4 * (int64_t(site.slots[a]) * kBlockNodes + local);
      const NodeSums<T> sum{n[3], {n[0], n[1], n[2]}};
      heavy[a] = node_velocity(s_, sum, dt, velocity[a]);
      mass[a] = sum.mass;
      present += heavy[a] ? 1 : 0;
    }
    const auto number = [&](int f) { return s_.slot_coord[4 * int64_t(site.slots[f]) + 3]; };
    const auto weight = [&](int field) { return mass[field]; };
    int64_t contacts = 0;
    if (present > 1) {
      const auto near = [&](int field, int o) {
        return contact_.sample(site.slots[field], local, o);
      };
      contacts = node_contact(s_, fields, heavy, number, weight, near, velocity) > 0 ? 1 : 0;
    }
    if (present > 1 && (marks & kTouchedPoints) != 0)
      node_hold(s_, fields, heavy, number, weight, given(site, local, touch_.sums()), velocity);
    const Vec3<T> x = node_position(site.slots[0], T(local / 16), T(local / 4 % 4), T(local % 4));
    if (site.colliders > 0 && present > 0) {
      for (int64_t i = 0; i < site.colliders; ++i) {
        const int32_t k = site.collider(i);
        for (int a = 0; a < fields; ++a)
          if (heavy[a] && holds_node(s_, k, x))
            node_collide(s_, k, x, mass[a], node_cut(s_, fields, heavy, number, a), dt, velocity[a],
                         impulse + kImpulseSums * k);
      }
    }
    if ((marks & kTouchedPush) != 0) {
      const auto nearest = [&] { return surface_.nearest(x); };
      const auto account = [&](int64_t k) { return impulse + kImpulseSums * k; };
      node_rub(s_, fields, heavy, number, weight, given(site, local, surface_.sums()), x, nearest,
               account, velocity);
    }
    for (int a = 0; a < fields; ++a) {
      T* out = s_.node_velocity + 4 * (int64_t(site.slots[a]) * kBlockNodes + local);
      for (int i = 0; i < 3; ++i) out[i] = velocity[a][i];
      out[3] = T(0);
    }
    return contacts;
  }

  // Sums of pushes at a node by field and component.
  static auto given(const Site& site, int local, const T* sums) {
    return [&site, local, sums](int f, int c) {
      return sums[4 * (int64_t(site.slots[f]) * kBlockNodes + local) + c];
    };
  }

  const SolverView<T>& s_;
  const ContactPlan<T>& contact_;
  SurfacePlan<T>& surface_;
  TouchPlan<T>& touch_;
  std::vector<double> impulse_;    // [chunks, colliders, kImpulseSums]
  std::vector<int64_t> contacts_;  // [chunks] nodes at which fields touched
};

}  // namespace gsf::cpu
