// CUDA back end of the resident solver: enqueues rounds of (blocks if wanted, then steps). Nothing
// here waits for the device; the clock says afterwards what happened.
#include "cuda/launch_solver.h"
#include "cuda/stream.h"
#include "host/solver.h"

namespace gsf {
namespace {

void check(const char* op, cudaError_t error) {
  STD_TORCH_CHECK(error == cudaSuccess, op, ": ", cudaGetErrorString(error));
}

struct Cuda {
  using Scope = CudaScope;
  template <typename T>
  static void prime(const SolverView<T>& s, int, const Scope& scope) {
    check("solver_prime", cuda::solver_prime(s, scope.stream()));
  }
  template <typename T>
  static void run(const SolverView<T>& s, int law_set, int64_t rounds, int64_t steps,
                  const Scope& scope) {
    for (int64_t r = 0; r < rounds; ++r) {
      check("solver_run", cuda::solver_build(s, scope.stream()));
      for (int64_t i = 0; i < steps; ++i)
        check("solver_run", cuda::solver_step(s, law_set, scope.stream()));
    }
  }
};

}  // namespace
}  // namespace gsf

STABLE_TORCH_LIBRARY_IMPL(gsfluent, CUDA, m) { gsf::SolverOps<gsf::Cuda>::register_all(m); }
