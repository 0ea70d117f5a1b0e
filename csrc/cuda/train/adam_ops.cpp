// CUDA registration of the optimiser step.
#include "cuda/stream.h"
#include "cuda/train/adam_launch.h"
#include "host/adam.h"

namespace gsf {
namespace {

struct AdamCuda {
  using Scope = CudaScope;
  GSF_LAUNCH(adam_step)
};

}  // namespace
}  // namespace gsf

GSF_REGISTER(CUDA, gsf::AdamOps<gsf::AdamCuda>)
