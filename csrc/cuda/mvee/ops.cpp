// CUDA registration of the enclosing-ellipsoid ops.
#include "cuda/mvee/launch.h"
#include "cuda/stream.h"
#include "host/mvee.h"

namespace gsf {
namespace {

struct MveeCuda {
  template <typename T>
  static void mvee(const MveeArgs<T>& args, const Tensor& like) {
    const CudaScope scope(like);
    const int64_t size = cuda::mvee_scratch(args);
    const Tensor scratch = gsf::new_empty(like, {size}, scalar_type_of<T>());
    STD_CUDA_CHECK(cuda::mvee(args, size > 0 ? mptr<T>(scratch) : nullptr, size, scope.stream()));
  }
  template <typename T>
  static void mvee_lens(const MveeLensArgs<T>& args, const Tensor& like) {
    const CudaScope scope(like);
    const int64_t chunk = args.batch < cuda::kLensChunk ? args.batch : cuda::kLensChunk;
    const Tensor setups = gsf::new_empty(like, {cuda::kLensFields * chunk}, ScalarType::Double);
    const Tensor rows = gsf::new_empty(like, {chunk + 1}, ScalarType::Int);
    STD_CUDA_CHECK(cuda::mvee_lens(args, mptr<double>(setups), mptr<int32_t>(rows),
                                   mptr<int32_t>(rows) + chunk, scope.stream()));
  }
};

}  // namespace
}  // namespace gsf

STABLE_TORCH_LIBRARY_IMPL(gsfluent, CUDA, m) {
  m.impl("mvee", TORCH_BOX(&gsf::MveeOps<gsf::MveeCuda>::mvee));
  m.impl("mvee_lens", TORCH_BOX(&gsf::MveeOps<gsf::MveeCuda>::mvee_lens));
}
