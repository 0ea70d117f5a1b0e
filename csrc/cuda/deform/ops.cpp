// CUDA registration of the deformation ops.
#include "cuda/deform/launch.h"
#include "cuda/stream.h"
#include "host/deform.h"

namespace gsf {
namespace {

struct DeformCuda {
  template <typename T>
  static void polar(const PolarArgs<T>& args, const Tensor& like) {
    const CudaScope scope(like);
    STD_CUDA_CHECK(cuda::polar(args, scope.stream()));
  }
  template <typename T>
  static void covariance_axes(const CovarianceAxesArgs<T>& args, const Tensor& like) {
    const CudaScope scope(like);
    STD_CUDA_CHECK(cuda::covariance_axes(args, scope.stream()));
  }
  template <typename T>
  static void carry_place(const CarryPlaceArgs<T>& args, const Tensor& like) {
    const CudaScope scope(like);
    STD_CUDA_CHECK(cuda::carry_place(args, scope.stream()));
  }
  template <typename T>
  static void carry_axes(const CarryAxesArgs<T>& args, const Tensor& like) {
    const CudaScope scope(like);
    STD_CUDA_CHECK(cuda::carry_axes(args, scope.stream()));
  }
};

}  // namespace
}  // namespace gsf

STABLE_TORCH_LIBRARY_IMPL(gsfluent, CUDA, m) {
  m.impl("polar_clamped", TORCH_BOX(&gsf::DeformOps<gsf::DeformCuda>::polar_clamped));
  m.impl("covariance_axes", TORCH_BOX(&gsf::DeformOps<gsf::DeformCuda>::covariance_axes));
  m.impl("carry_place", TORCH_BOX(&gsf::DeformOps<gsf::DeformCuda>::carry_place));
  m.impl("carry_axes", TORCH_BOX(&gsf::DeformOps<gsf::DeformCuda>::carry_axes));
}
