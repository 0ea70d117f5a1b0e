// CUDA back end of the MPM operators: current stream, launch, error check. Physics and checks live
// elsewhere.
#include "cuda/mpm/launch.h"
#include "cuda/stream.h"
#include "host/mpm.h"

namespace gsf {
namespace {

void check(const char* op, cudaError_t error) {
  STD_TORCH_CHECK(error == cudaSuccess, op, ": ", cudaGetErrorString(error));
}

struct Cuda {
  using Scope = CudaScope;
  template <typename T>
  static void p2g(const P2GArgs<T>& a, const Scope& scope) {
    check("p2g", cuda::p2g(a, scope.stream()));
  }
  template <typename T>
  static void g2p(const GatherArgs<T>& a, const Scope& scope) {
    check("g2p", cuda::g2p(a, scope.stream()));
  }
  template <typename T>
  static void p2g_adjoint(const GatherArgs<T>& a, const Scope& scope) {
    check("p2g_adjoint", cuda::p2g_adjoint(a, scope.stream()));
  }
  template <typename T>
  static void grid_update(const GridUpdateArgs<T>& a, const Scope& scope) {
    check("grid_update", cuda::grid_update(a, scope.stream()));
  }
};

}  // namespace
}  // namespace gsf

STABLE_TORCH_LIBRARY_IMPL(gsfluent, CUDA, m) { gsf::MpmOps<gsf::Cuda>::register_all(m); }
