// The resident solver on the CPU: priming and the loop over steps. See cpu/solver/solver.h.
#include "host/solver.h"

#include "cpu/mpm/flip.h"
#include "cpu/ranks/ranks.h"
#include "cpu/solver/homes.h"

namespace gsf::cpu {
namespace {

constexpr int64_t kParticleGrain = 2048;

void give_largest(const Largest& l, SolverClock& c) {
  c.speed = bits_of(std::sqrt(l.speed2));
  // Not every step looks at these: what an earlier one saw stays until the clock forgets it. The
  // bits of floats that are not negative are ordered as the floats are.
  c.wave = std::max<uint64_t>(c.wave, bits_of(std::sqrt(l.wave2)));
  c.gradient = std::max<uint64_t>(c.gradient, bits_of(std::sqrt(l.gradient2)));
}

// What one rank does in a step.
template <typename T>
class Stepper {
 public:
  Stepper(Rank<T>& rank, int laws, bool several)
      : s_(rank.view),
        laws_(laws),
        touched_(rank.touched),
        contact_(s_),
        surface_(s_),
        touch_(s_, contact_),
        homes_(s_, contact_, surface_, touch_),
        nodes_(s_, contact_, surface_, touch_, several ? &rank.sites : nullptr) {
    if (laws == kDamageField) fields_ = std::make_unique<FieldPass<T>>(s_);
    if (s_.own != nullptr) flip_ = std::make_unique<FlipPass<T>>(s_);
  }

  // Everything that follows from the blocks; again after each build.
  void plan() {
    contact_.make();
    surface_.make();
    touch_.make();
    homes_.plan();
    nodes_.plan();
    if (fields_) fields_->plan();
    if (flip_) flip_->plan();
  }

  Counts to_nodes(int color) { return homes_.to_nodes(color, touched_); }
  T* pushes() { return surface_.sums(); }
  TouchPlan<T>& touch() { return touch_; }
  int64_t nodes() { return nodes_.run(static_cast<T>(s_.clock->dt), touched_); }
  NodePass<T>& given() { return nodes_; }
  FlipPass<T>* flip() { return flip_.get(); }
  Counts from_nodes() {
    if (flip_) return flip_->from_nodes(homes_, laws_);
    return fields_ ? fields_->from_nodes(homes_) : homes_.from_nodes(laws_);
  }

 private:
  const SolverView<T>& s_;
  const int laws_;
  std::vector<uint8_t>& touched_;
  ContactPlan<T> contact_;
  SurfacePlan<T> surface_;
  TouchPlan<T> touch_;
  HomePass<T> homes_;
  NodePass<T> nodes_;
  std::unique_ptr<FieldPass<T>> fields_;
  std::unique_ptr<FlipPass<T>> flip_;
};

// All ranks, phase by phase.
template <typename T>
class Lockstep {
 public:
  Lockstep(const SolverView<T>& s, int laws)
      : s_(s), cut_(s), sums_(cut_.halos()), flip_sums_(cut_.halos()) {
    for (Rank<T>& rank : cut_.ranks())
      ranks_.push_back(std::make_unique<Stepper<T>>(rank, laws, cut_.several()));
  }

  void build() {
    if (cut_.several())
      solver_build(s_, cut_);
    else
      solver_build(s_);
  }
  // After the last step.
  void gather() { cut_.gather(); }

  // Again after each build.
  void plan() {
    const SolverClock& c = *s_.clock;
    STD_TORCH_CHECK(c.homes >= 0 && c.homes <= s_.home_capacity && c.slots >= 0 &&
                        c.slots <= s_.slot_capacity && c.sites >= 0 && c.sites <= c.slots,
                    "solver: the clock counts more blocks than there is room for");
    cut_.make();
    for (auto& rank : ranks_) rank->plan();
    if (!cut_.several()) return;
    const auto each = [&](const auto& f) {
      std::vector<std::invoke_result_t<decltype(f), size_t>> of_rank;
      for (size_t r = 0; r < ranks_.size(); ++r) of_rank.push_back(f(r));
      return of_rank;
    };
    std::vector<Rank<T>>& own = cut_.ranks();
    constexpr int64_t kReal = sizeof(T);
    sums_.plan(each([&](size_t r) { return own[r].touched.data(); }));
    sums_.share(kTouchedSums, 4 * sizeof(double), each([&](size_t r) { return own[r].view.sums; }));
    sums_.share(kTouchedMoments, kContactMoments * kReal,
                each([&](size_t r) { return own[r].view.moments; }));
    sums_.share(kTouchedPush, 4 * kReal,
                each([&](size_t r) { return static_cast<void*>(ranks_[r]->pushes()); }));
    sums_.share(kTouchedPoints, 4 * kReal,
                each([&](size_t r) { return static_cast<void*>(ranks_[r]->touch().sums()); }));
    if (s_.own == nullptr) return;
    flip_sums_.plan(each([&](size_t r) { return ranks_[r]->flip()->touched(); }));
    flip_sums_.share(kTouchedSums, 4 * sizeof(double),
                     each([&](size_t r) { return static_cast<void*>(ranks_[r]->flip()->sums()); }));
  }

  void step() {
    SolverClock& c = *s_.clock;
    cut_.begin();
    touch();
    Counts all = to_nodes(sums_, [](Stepper<T>& rank, int color) { return rank.to_nodes(color); });
    for (auto& rank : ranks_) c.touched += rank->nodes();
    end_colliders();
    if (s_.own != nullptr)
      all.add(to_nodes(flip_sums_,
                       [](Stepper<T>& rank, int color) { return rank.flip()->to_nodes(color); }));
    for (auto& rank : ranks_) all.add(rank->from_nodes());
    c.plastic += all.plastic;
    c.guarded += all.guarded;
    c.inverted += all.inverted;
    c.invalid += all.invalid;
    c.lost += all.lost;
    if (all.leaves) c.leaving += 1;
    give_largest(all.largest, c);
    end_step(c, double(s_.dx), s_.count);
  }

 private:
  // f(rank, colour) of all ranks, which agree on their sums in between.
  template <typename F>
  Counts to_nodes(Agreement& sums, const F& f) {
    Counts all;
    sums.begin();
    for (int color = 0; color < kColors; ++color) {
      for (auto& rank : ranks_) all.add(f(*rank, color));
      sums.agree();
    }
    return all;
  }
  // What points get that other bodies push.
  void touch() {
    if (!cut_.several()) return ranks_[0]->touch().run();
    std::vector<typename TouchPlan<T>::Offer> offers;
    for (size_t r = 0; r < ranks_.size(); ++r)
      ranks_[r]->touch().offer(static_cast<int32_t>(r), cut_.ranks()[r].homes, offers);
    std::stable_sort(offers.begin(), offers.end(),
                     [](const auto& a, const auto& b) { return a.home < b.home; });
    for (size_t r = 0; r < ranks_.size(); ++r)
      ranks_[r]->touch().take(static_cast<int32_t>(r), offers);
  }
  void end_colliders() {
    if (!cut_.several()) return ranks_[0]->given().end_colliders();
    std::vector<Given> given;
    for (auto& rank : ranks_) rank->given().give(given);
    cut_.end_colliders(given);
  }

  const SolverView<T>& s_;
  RankCut<T> cut_;
  Agreement sums_, flip_sums_;
  std::vector<std::unique_ptr<Stepper<T>>> ranks_;
};

template <typename T>
void prime_particles(const SolverView<T>& s, int laws, bool measure) {
  SolverClock& c = *s.clock;
  const T dt = static_cast<T>(c.dt);
  const Counts all =
      laws == kDamageField
          ? FieldPass<T>::prime(s, measure)
          : parallel_counts(s.count, kParticleGrain,
                            [&](int64_t begin, int64_t end, Counts& counts) {
                              if (laws == kMoreLaws)
                                return prime_more(s, begin, end, measure, dt, counts.largest);
                              if (with_springs(laws))
                                return prime_viscous(s, begin, end, measure, dt, counts.largest);
                              for (int64_t p = begin; p < end; ++p)
                                prime_particle(s, p, measure, dt, counts.largest);
                            });
  if (measure)
    give_largest(all.largest, c);
  else
    c.bound = bits_of(all.largest.bound);
}

struct Cpu {
  using Scope = CpuScope;
  static constexpr bool kHasRanks = true;

  template <typename T>
  static void prime(const SolverView<T>& s, int laws, const Scope&) {
    SolverClock& c = *s.clock;
    if (s.row_count == 0) return;
    prime_particles(s, laws, true);
    start_clock(c, double(s.dx));
    if (c.done != 0 || c.reason != kFine) return;
    prime_particles(s, laws, false);
    choose_unit(c);
  }

  // Points, homes, slots of each rank, and slots that others hold too; since the last build.
  template <typename T>
  static void ranks(const SolverView<T>& s, int64_t* out) {
    RankCut<T> cut(s);
    cut.make();
    const std::vector<Rank<T>>& of = cut.ranks();
    for (size_t r = 0; r < of.size(); ++r) {
      const SolverClock& c = *of[r].view.clock;
      const int64_t row[] = {of[r].view.count, c.homes, c.slots, 0};
      std::copy_n(row, 4, out + 4 * r);
    }
    for (const Halos::Holder& holder : cut.halos().holders) ++out[4 * holder.rank + 3];
  }

  template <typename T>
  static void run(const SolverView<T>& s, int laws, int64_t rounds, int64_t steps, const Scope&) {
    SolverClock& c = *s.clock;
    if (s.row_count == 0) return;
    STD_TORCH_CHECK(s.ranks == 1 || laws != kDamageField,
                    "solver: several ranks know no phase field");
    Lockstep<T> ranks(s, laws);
    if (may_step(c)) ranks.plan();
    for (int64_t i = 0; i < rounds * steps; ++i) {
      if (may_build(c)) {
        ranks.build();
        if (may_step(c)) ranks.plan();
      }
      if (!may_step(c)) break;
      ranks.step();
    }
    ranks.gather();
  }
};

}  // namespace
}  // namespace gsf::cpu

GSF_REGISTER(CPU, gsf::SolverOps<gsf::cpu::Cpu>)
