// CUDA registration of the enclosing-ellipsoid ops.
#include "cuda/launch_material.h"
#include "cuda/stream.h"
#include "host/mvee.h"

namespace gsf {
namespace {

struct MveeCuda {
  template <typename T>
  static void mvee(const MveeArgs<T>& args, const Tensor& like) {
    const CudaScope scope(like);
    STD_CUDA_CHECK(cuda::mvee(args, scope.stream()));
  }
  template <typename T>
  static void mvee_lens(const MveeLensArgs<T>& args, const Tensor& like) {
    const CudaScope scope(like);
    STD_CUDA_CHECK(cuda::mvee_lens(args, scope.stream()));
  }
};

}  // namespace
}  // namespace gsf

STABLE_TORCH_LIBRARY_IMPL(gsfluent, CUDA, m) {
  m.impl("mvee", TORCH_BOX(&gsf::MveeOps<gsf::MveeCuda>::mvee));
  m.impl("mvee_lens", TORCH_BOX(&gsf::MveeOps<gsf::MveeCuda>::mvee_lens));
}
