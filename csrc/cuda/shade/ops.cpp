// CUDA registration of the shading op.
#include "cuda/shade/launch.h"
#include "cuda/stream.h"
#include "host/shade.h"

namespace gsf {
namespace {

struct ShadeCuda {
  using Scope = CudaScope;
  GSF_LAUNCH(shade)
};

}  // namespace
}  // namespace gsf

GSF_REGISTER(CUDA, gsf::ShadeOps<gsf::ShadeCuda>)
