// Launchers of the resident solver's kernels; torch-free.
#pragma once

#include <cuda_runtime_api.h>

#include "core/solver/node.h"
#include "core/solver/particle.h"

namespace gsf::cuda {

constexpr int kSolverThreads = 256;

// Builds blocks when the clock asks for them; does nothing otherwise.
template <typename T>
cudaError_t solver_build(const SolverView<T>& s, cudaStream_t stream);
// One step, when the clock allows it.
template <typename T>
cudaError_t solver_step(const SolverView<T>& s, int law_set, cudaStream_t stream);
template <typename T>
cudaError_t solver_prime(const SolverView<T>& s, int law_set, cudaStream_t stream);

// Parts of these, between which several ranks wait for each other (cuda/ranks/ranks.h). Before the
// first step: its speeds, then its stress, and the clock of each. In a step: points to nodes,
// without and with what acts on them; nodes, and nodes to points. One rank's step ends with that;
// what several told makes its end, that of the view of all too if it is to.
template <typename T>
void solver_prime_points(const SolverView<T>& s, int law_set, bool measure, cudaStream_t stream);
template <typename T>
void solver_start(const SolverView<T>& s, bool measure, cudaStream_t stream);
template <typename T>
void solver_free_to_nodes(const SolverView<T>& s, cudaStream_t stream);
template <typename T>
void solver_free_nodes(const SolverView<T>& s, cudaStream_t stream);
template <typename T>
void solver_to_nodes(const SolverView<T>& s, cudaStream_t stream);
template <typename T>
void solver_from_nodes(const SolverView<T>& s, int law_set, cudaStream_t stream);
template <typename T>
void solver_end(const SolverView<T>& s, bool with_all, cudaStream_t stream);

// Parts by what a scene has.
// Points that keep a share of their own motion: g2p (solver_free_to_nodes came before).
template <typename T>
void solver_keep(const SolverView<T>& s, int law_set, cudaStream_t stream);
// Phase-field matter: which slots have points whose damage is solved for, at the end of a build;
// the damage field, beside all of a step up to its nodes; and g2p once both are done.
template <typename T>
void solver_damage_marks(const SolverView<T>& s, cudaStream_t stream);
template <typename T>
void solver_damage_begin(const SolverView<T>& s, cudaStream_t stream);
template <typename T>
void solver_damage_end(const SolverView<T>& s, bool begun, cudaStream_t stream);
// Points that are pushed: what of their rows a step needs, and what they get in one, in parts
// between which several ranks wait for each other.
template <typename T>
void solver_spring_rows(const SolverView<T>& s, cudaStream_t stream);
template <typename T>
int points_parts(const SolverView<T>& s) {
  if (s.radius == nullptr) return 0;
  return s.object != nullptr && s.moments != nullptr ? 4 : 2;
}
template <typename T>
void solver_points(const SolverView<T>& s, int part, cudaStream_t stream);

}  // namespace gsf::cuda
