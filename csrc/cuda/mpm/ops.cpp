// CUDA back end of the MPM operators: current stream, launch, error check. Physics and checks live
// elsewhere.
#include "cuda/mpm/launch.h"
#include "cuda/stream.h"
#include "host/mpm.h"

namespace gsf {
namespace {

struct MpmCuda {
  using Scope = CudaScope;
  GSF_LAUNCH(p2g)
  GSF_LAUNCH(g2p)
  GSF_LAUNCH(p2g_adjoint)
  GSF_LAUNCH(grid_update)
};

}  // namespace
}  // namespace gsf

GSF_REGISTER(CUDA, gsf::MpmOps<gsf::MpmCuda>)
