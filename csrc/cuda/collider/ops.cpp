// CUDA back end of the collider operators: current stream, launch, error check.
#include "cuda/collider/launch.h"
#include "cuda/stream.h"
#include "host/collider.h"

namespace gsf {
namespace {

struct ColliderCuda {
  using Scope = CudaScope;
  template <typename T>
  static void distance(const ColliderDistanceArgs<T>& a, const Scope& scope) {
    STD_CUDA_CHECK(cuda::collider_distance(a, scope.stream()));
  }
  template <typename T>
  static void advance(const AdvanceCollidersArgs<T>& a, const Scope& scope) {
    STD_CUDA_CHECK(cuda::advance_colliders(a, scope.stream()));
  }
  template <typename T>
  static void blade_sides(const BladeSidesArgs<T>& a, const Scope& scope) {
    STD_CUDA_CHECK(cuda::blade_sides(a, scope.stream()));
  }
};

}  // namespace
}  // namespace gsf

STABLE_TORCH_LIBRARY_IMPL(gsfluent, CUDA, m) {
  gsf::ColliderOps<gsf::ColliderCuda>::register_all(m);
}
