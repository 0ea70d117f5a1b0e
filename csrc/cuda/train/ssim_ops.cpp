// CUDA registration of SSIM and of the photometric loss.
#include "cuda/stream.h"
#include "cuda/train/ssim_launch.h"
#include "host/ssim.h"

namespace gsf {
namespace {

struct SsimCuda {
  template <typename T>
  static void run(const SsimArgs<T>& a, const Tensor& like) {
    const CudaScope scope(like);
    cuda::SsimPlan plan{};
    STD_CUDA_CHECK(cuda::ssim_plan(a, scope.index(), plan));
    const bool gradient = a.grad_image != nullptr;
    const Tensor slopes =
        gsf::new_empty(like, {gradient ? 3 * a.map_count() : 0}, scalar_type_of<T>());
    const Tensor sums =
        gsf::new_empty(like, {a.loss != nullptr ? plan.sums() : 0}, ScalarType::Double);
    STD_CUDA_CHECK(cuda::ssim(a, plan, gradient ? mptr<T>(slopes) : nullptr,
                              a.loss != nullptr ? mptr<double>(sums) : nullptr, scope.stream()));
  }
};

}  // namespace
}  // namespace gsf

STABLE_TORCH_LIBRARY_IMPL(gsfluent, CUDA, m) {
  m.impl("ssim", TORCH_BOX(&gsf::SsimOps<gsf::SsimCuda>::map));
  m.impl("ssim_backward", TORCH_BOX(&gsf::SsimOps<gsf::SsimCuda>::map_backward));
  m.impl("photometric_loss", TORCH_BOX(&gsf::SsimOps<gsf::SsimCuda>::photometric));
}
