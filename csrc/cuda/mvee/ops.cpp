// CUDA registration of the enclosing-ellipsoid ops.
#include "cuda/mvee/launch.h"
#include "cuda/stream.h"
#include "host/mvee.h"

namespace gsf {
namespace {

struct MveeCuda {
  using Scope = CudaScope;
  template <typename T>
  static void mvee(const MveeArgs<T>& args, const Scope& scope) {
    const int64_t size = cuda::mvee_scratch(args);
    const Tensor scratch = scope.scratch(size, scalar_type_of<T>());
    check_cuda("mvee",
               cuda::mvee(args, size > 0 ? mptr<T>(scratch) : nullptr, size, scope.stream()));
  }
  template <typename T>
  static void mvee_lens(const MveeLensArgs<T>& args, const Scope& scope) {
    const int64_t chunk = args.batch < cuda::kLensChunk ? args.batch : cuda::kLensChunk;
    const Tensor setups = scope.scratch(cuda::kLensFields * chunk, ScalarType::Double);
    const Tensor rows = scope.scratch(chunk + 1, ScalarType::Int);
    check_cuda("mvee_lens", cuda::mvee_lens(args, mptr<double>(setups), mptr<int32_t>(rows),
                                            mptr<int32_t>(rows) + chunk, scope.stream()));
  }
};

}  // namespace
}  // namespace gsf

GSF_REGISTER(CUDA, gsf::MveeOps<gsf::MveeCuda>)
