// CUDA registration of the shading op.
#include "cuda/shade/launch.h"
#include "cuda/stream.h"
#include "host/shade.h"

namespace gsf {
namespace {

struct ShadeCuda {
  template <typename T>
  static void shade(const ShadeArgs<T>& args, const Tensor& like) {
    const CudaScope scope(like);
    STD_CUDA_CHECK(cuda::shade(args, scope.stream()));
  }
};

}  // namespace
}  // namespace gsf

STABLE_TORCH_LIBRARY_IMPL(gsfluent, CUDA, m) {
  m.impl("shade", TORCH_BOX(&gsf::ShadeOps<gsf::ShadeCuda>::shade));
}
