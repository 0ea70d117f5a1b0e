// CUDA back end of the collider operators: current stream, launch, error check.
#include "cuda/collider/launch.h"
#include "cuda/stream.h"
#include "host/collider.h"

namespace gsf {
namespace {

struct ColliderCuda {
  using Scope = CudaScope;
  GSF_LAUNCH(collider_distance)
  GSF_LAUNCH(advance_colliders)
  GSF_LAUNCH(blade_sides)
};

}  // namespace
}  // namespace gsf

GSF_REGISTER(CUDA, gsf::ColliderOps<gsf::ColliderCuda>)
