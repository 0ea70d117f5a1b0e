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

}  // namespace gsf::cuda
