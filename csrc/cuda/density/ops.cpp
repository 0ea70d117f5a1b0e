// CUDA registration of the density ops.
#include "cuda/density/launch.h"
#include "cuda/stream.h"
#include "host/density.h"

namespace gsf {
namespace {

struct DensityCuda {
  template <typename T>
  static void occupancy(const DensityArgs<T>& args, const Tensor& like) {
    const CudaScope scope(like);
    STD_CUDA_CHECK(cuda::occupancy(args, scope.stream()));
  }
  template <typename T>
  static void bulk(const BulkArgs<T>& args, const Tensor& like) {
    const CudaScope scope(like);
    STD_CUDA_CHECK(cuda::splat_bulk(args, scope.stream()));
  }
  template <typename T>
  static void normals(const DensityNormalArgs<T>& args, const Tensor& like) {
    const CudaScope scope(like);
    STD_CUDA_CHECK(cuda::density_normals(args, scope.stream()));
  }
};

}  // namespace
}  // namespace gsf

STABLE_TORCH_LIBRARY_IMPL(gsfluent, CUDA, m) {
  m.impl("occupancy", TORCH_BOX(&gsf::DensityOps<gsf::DensityCuda>::occupancy));
  m.impl("splat_bulk", TORCH_BOX(&gsf::DensityOps<gsf::DensityCuda>::bulk));
  m.impl("density_normals", TORCH_BOX(&gsf::DensityOps<gsf::DensityCuda>::normals));
}
