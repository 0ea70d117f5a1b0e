// Nodes of the resident solver on the CPU: sums to velocities, contact, colliders, site by site.
#pragma once

#include <numeric>

#include "core/solver/points.h"
#include "cpu/contact/points.h"
#include "cpu/solver/surface.h"

namespace gsf::cpu {

constexpr int64_t kSlotGrain = 64;
constexpr int64_t kSiteChunk = 16;  // sites per ordered partial sum; fixed, so that sums are too
constexpr int64_t kNearColliders = 64;  // with more, every site looks at all of them

// What one node gave to a collider, on its way from one rank of several to the sums of all.
struct Given {
  int64_t site;  // its number among the sites of all ranks
  int64_t collider;
  double sums[kImpulseSums];
};
// Sites of one rank of several. Others that hold a site compute the same there; one answers for it.
struct RankSites {
  std::vector<uint8_t> answers;  // [sites]
  std::vector<int64_t> number;   // [sites] among those of all ranks
};

template <typename T>
class NodePass {
 public:
  NodePass(const SolverView<T>& s, const ContactPlan<T>& contact, SurfacePlan<T>& surface,
           TouchPlan<T>& touch, const RankSites* sites)
      : s_(s), contact_(contact), surface_(surface), touch_(touch), sites_(sites) {}

  void plan() {
    const int64_t chunks = (s_.clock->sites + kSiteChunk - 1) / kSiteChunk;
    impulse_.assign(chunks * s_.collider_count * kImpulseSums, 0.0);
    contacts_.assign(chunks, 0);
    given_.resize(sites_ != nullptr ? chunks : 0);
  }

  // All nodes of touched slots; clears their sums and the marks. Returns how many were touched by
  // several fields.
  int64_t run(T dt, std::vector<uint8_t>& touched) {
    SolverClock& c = *s_.clock;
    const int64_t chunks = static_cast<int64_t>(contacts_.size()),
                  terms = kImpulseSums * s_.collider_count;
    parallel_for(chunks, 1, [&](int64_t begin, int64_t end) {
      for (int64_t chunk = begin; chunk < end; ++chunk) {
        double* impulse = impulse_.data() + chunk * terms;
        std::fill(impulse, impulse + terms, 0.0);
        contacts_[chunk] = 0;
        Account account{impulse, sites_ != nullptr ? &given_[chunk] : nullptr, 0};
        if (sites_ != nullptr) given_[chunk].clear();
        const int64_t last = std::min((chunk + 1) * kSiteChunk, c.sites);
        for (int64_t index = chunk * kSiteChunk; index < last; ++index) {
          const Site here = site(index, touched);
          if (here.fields == 0) continue;
          int marks = 0;
          for (int i = 0; i < here.fields; ++i) marks |= touched[here.slots[i]];
          if (sites_ != nullptr) account.site = sites_->number[index];
          const size_t before = sites_ != nullptr ? account.list->size() : 0;
          int64_t contacts = 0;
          for (int local = 0; local < kBlockNodes; ++local)
            contacts += node(here, local, marks, dt, account);
          if (sites_ == nullptr || sites_->answers[index] != 0)
            contacts_[chunk] += contacts;
          else
            account.list->resize(before);
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
    return std::accumulate(contacts_.begin(), contacts_.end(), int64_t(0));
  }

  // After run, in the one rank that holds all: books what colliders got, and moves them.
  void end_colliders() {
    const int64_t terms = kImpulseSums * s_.collider_count;
    for (int64_t k = 0; k < s_.collider_count; ++k) {
      double sums[kImpulseSums] = {};
      for (size_t chunk = 0; chunk < contacts_.size(); ++chunk)
        for (int i = 0; i < kImpulseSums; ++i)
          sums[i] += impulse_[chunk * terms + k * kImpulseSums + i];
      end_collider(s_, k, sums, s_.clock->dt);
    }
  }
  // After run, in one rank of several: what colliders got, in the order of its sites.
  void give(std::vector<Given>& all) const {
    for (const std::vector<Given>& chunk : given_)
      all.insert(all.end(), chunk.begin(), chunk.end());
  }

 private:
  // Where what a chunk of sites gives goes: to the sums of each collider, or, in one rank of
  // several, one by one to a list, so that all of it can be added in the order of all sites.
  struct Account {
    double* impulse;
    std::vector<Given>* list;
    int64_t site;

    double* of(int64_t k) {
      if (list == nullptr) return impulse + kImpulseSums * k;
      list->push_back({site, k, {}});
      return list->back().sums;
    }
  };

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
  int64_t node(const Site& site, int local, int marks, T dt, Account& account) {
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
                         account.of(k));
      }
    }
    if ((marks & kTouchedPush) != 0) {
      const auto nearest = [&] { return surface_.nearest(x); };
      const auto sums_of = [&](int64_t k) { return account.of(k); };
      node_rub(s_, fields, heavy, number, weight, given(site, local, surface_.sums()), x, nearest,
               sums_of, velocity);
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
  const RankSites* sites_;                 // null: all sites are here
  std::vector<double> impulse_;            // [chunks, colliders, kImpulseSums]
  std::vector<int64_t> contacts_;          // [chunks] nodes at which fields touched
  std::vector<std::vector<Given>> given_;  // [chunks] of one rank of several
};

}  // namespace gsf::cpu
