// CUDA registration of the ops on graphs.
#include "cuda/graph/launch.h"
#include "cuda/stream.h"
#include "host/graph.h"

namespace gsf {
namespace {

struct GraphCuda {
  using Scope = CudaScope;
  GSF_LAUNCH(link_costs)
  GSF_LAUNCH(components)
  GSF_LAUNCH(nearest_seeds)
};

}  // namespace
}  // namespace gsf

GSF_REGISTER(CUDA, gsf::GraphOps<gsf::GraphCuda>)
