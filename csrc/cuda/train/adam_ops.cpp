// CUDA registration of the optimiser step.
#include "cuda/stream.h"
#include "cuda/train/adam_launch.h"
#include "host/adam.h"

namespace gsf {
namespace {

struct AdamCuda {
  template <typename T>
  static void step(const AdamArgs<T>& args, const Tensor& like) {
    const CudaScope scope(like);
    STD_CUDA_CHECK(cuda::adam_step(args, scope.stream()));
  }
};

}  // namespace
}  // namespace gsf

STABLE_TORCH_LIBRARY_IMPL(gsfluent, CUDA, m) {
  m.impl("adam_step", TORCH_BOX(&gsf::AdamOps<gsf::AdamCuda>::step));
}
