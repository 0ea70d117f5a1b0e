// The CPU half of the resident solver, in three parts: blocks (solver_build.cpp), particles
// (solver_transfer.h), nodes and the loop over steps (solver.cpp).
#pragma once

#include <vector>

#include "core/solver_state.h"

namespace gsf::cpu {

// New homes and slots for the particles as they are, which are re-sorted; or clock.grow or
// clock.reason, and nothing else changed.
template <typename T>
void solver_build(const SolverView<T>& s);

}  // namespace gsf::cpu
