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

// Parts of these, by what a scene has.
// Points that keep a share of their own motion: the pass without forces before a step, and g2p.
template <typename T>
void solver_free(const SolverView<T>& s, cudaStream_t stream);
template <typename T>
void solver_keep(const SolverView<T>& s, int law_set, cudaStream_t stream);
// Points that are pushed: what of their rows a step needs, and what they get in one.
template <typename T>
void solver_spring_rows(const SolverView<T>& s, cudaStream_t stream);
template <typename T>
void solver_points(const SolverView<T>& s, cudaStream_t stream);

}  // namespace gsf::cuda
