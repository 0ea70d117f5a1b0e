// The CPU half of the resident solver: blocks (build.cpp), particles of a home to its window
// and back (homes.h, packet.h, update.h), nodes (nodes.h, contact.h), points that colliders push
// (surface.h) and that push each other (cpu/contact/points.h), the loop over steps (solver.cpp).
// Every sum is taken in an order that depends on neither the number of threads nor the order in
// which the particles were loaded.
#pragma once

#include <algorithm>
#include <atomic>
#include <memory>
#include <vector>

#include "core/solver/particle.h"
#include "torch_api.h"

namespace gsf::cpu {

// New homes and slots for the particles as they are, which are re-sorted; or clock.grow or
// clock.reason, and nothing else changed.
template <typename T>
void solver_build(const SolverView<T>& s);

// prime_particle of particles [begin, end) of a scene with laws of more_laws.h.
template <typename T>
void prime_more(const SolverView<T>& s, int64_t begin, int64_t end, bool measure, T dt,
                Largest& largest);
// The same of a scene with viscous matter.
template <typename T>
void prime_viscous(const SolverView<T>& s, int64_t begin, int64_t end, bool measure, T dt,
                   Largest& largest);
template <typename T>
class HomePass;
template <typename T>
class DamagePass;
template <typename T>
class FlipPass;
struct Counts;

// Phase-field matter (solver_fields.cpp, a file of its own: what gcc inlines elsewhere stays as it
// is).
template <typename T>
class FieldPass {
 public:
  explicit FieldPass(const SolverView<T>& s);
  ~FieldPass();
  void plan();  // again after each build
  // The damage field, then HomePass::from_nodes.
  Counts from_nodes(const HomePass<T>& homes);
  static Counts prime(const SolverView<T>& s, bool measure);

 private:
  std::unique_ptr<DamagePass<T>> damage_;
};

// What a slot holds in this step.
enum Touched : uint8_t {
  kTouchedSums = 1,
  kTouchedMoments = 2,
  kTouchedPush = 4,
  kTouchedPoints = 8
};

// Counts and largest values of some particles. They do not depend on the order in which they meet.
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

// What f(begin, end, Counts&) counts over [0, n), on all threads.
template <typename F>
Counts parallel_counts(int64_t n, int64_t grain, const F& f) {
  Counts all;
  std::atomic_flag busy;
  parallel_for(n, grain, [&](int64_t begin, int64_t end) {
    Counts mine;
    f(begin, end, mine);
    while (busy.test_and_set(std::memory_order_acquire)) busy.wait(true);
    all.add(mine);
    busy.clear(std::memory_order_release);
    busy.notify_one();
  });
  return all;
}

}  // namespace gsf::cpu
