// The part of their own motion that points of the resident solver keep in a step: FLIP beside APIC.
#pragma once

#include <memory>
#include <vector>

#include "cpu/solver/solver.h"

namespace gsf::cpu {

template <typename T>
class FlipPass {
 public:
  explicit FlipPass(const SolverView<T>& s);
  ~FlipPass();
  FlipPass(const FlipPass&) = delete;
  FlipPass& operator=(const FlipPass&) = delete;

  void plan();  // again after each build
  // HomePass::to_nodes of what would go on if nothing acted on it, to nodes apart from those of the
  // step: the homes of one colour, and the sums and marks they go to.
  Counts to_nodes(int color);
  double* sums();
  uint8_t* touched();
  // Then HomePass::from_nodes with laws other than kDamageField. Takes from each particle's
  // velocity and `own` what would come back if nothing acted on the nodes, and leaves the share of
  // it that is kept; keep_own (core/solver/particle.h) adds what did come back.
  Counts from_nodes(const HomePass<T>& homes, int laws);

 private:
  struct Passes;
  std::unique_ptr<Passes> passes_;
};

}  // namespace gsf::cpu
