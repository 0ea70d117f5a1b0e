// CUDA registration of return_mapping.
#include "cuda/material/launch.h"
#include "cuda/stream.h"
#include "host/plasticity.h"

namespace gsf {
namespace {

struct PlasticityCuda {
  template <typename T>
  static void return_mapping(const ReturnMappingArgs<T>& args, const Tensor& like) {
    const CudaScope scope(like);
    STD_CUDA_CHECK(cuda::return_mapping(args, scope.stream()));
  }
};

}  // namespace
}  // namespace gsf

STABLE_TORCH_LIBRARY_IMPL(gsfluent, CUDA, m) {
  m.impl("return_mapping", TORCH_BOX(&gsf::PlasticityOps<gsf::PlasticityCuda>::return_mapping));
}
