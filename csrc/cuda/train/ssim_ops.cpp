// CUDA registration of SSIM and of the photometric loss.
#include "cuda/stream.h"
#include "cuda/train/ssim_launch.h"
#include "host/ssim.h"

namespace gsf {
namespace {

struct SsimCuda {
  using Scope = CudaScope;
  template <typename T>
  static void run(const SsimArgs<T>& a, const Scope& scope) {
    cuda::SsimPlan plan{};
    check_cuda("ssim", cuda::ssim_plan(a, scope.index(), plan));
    const bool gradient = a.grad_image != nullptr;
    const Tensor slopes = scope.scratch(gradient ? 3 * a.map_count() : 0, scalar_type_of<T>());
    const Tensor sums = scope.scratch(a.loss != nullptr ? plan.sums() : 0, ScalarType::Double);
    check_cuda("ssim",
               cuda::ssim(a, plan, gradient ? mptr<T>(slopes) : nullptr,
                          a.loss != nullptr ? mptr<double>(sums) : nullptr, scope.stream()));
  }
};

}  // namespace
}  // namespace gsf

GSF_REGISTER(CUDA, gsf::SsimOps<gsf::SsimCuda>)
