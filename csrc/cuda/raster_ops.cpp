// The rasterizer's CUDA backend: scratch from torch's allocator, registration.
#include "cuda/launch_raster.h"
#include "cuda/stream.h"
#include "host/raster.h"

namespace gsf {
namespace {

void check_raster_launch(cudaError_t error) {
  STD_TORCH_CHECK(error == cudaSuccess, kRasterOp, ": CUDA error: ", cudaGetErrorString(error));
}

struct RasterCuda {
  using Scope = CudaScope;

  template <typename T>
  class Plan {
   public:
    Plan(const RasterArgs<T>& a, const Tensor& like, const Scope& scope)
        : a_(a), like_(like), scope_(scope) {
      offsets_ = gsf::new_empty(like, {a.count}, ScalarType::Long);
      const size_t bytes = a.count > 0 ? cuda::raster_order_scratch(a.count) : 0;
      Tensor scratch = gsf::new_empty(like, {static_cast<int64_t>(bytes)}, ScalarType::Byte);
      check_raster_launch(cuda::raster_order(a, mptr<uint8_t>(scratch), bytes,
                                             mptr<int64_t>(offsets_), &total_, scope.stream()));
    }

    int64_t instance_count() const { return total_; }

    void blend() {
      const int64_t tiles = int64_t(a_.tiles_x) * a_.tiles_y;
      const size_t bytes = total_ > 0 ? cuda::raster_bin_scratch(total_, tiles) : 0;
      Tensor scratch = gsf::new_empty(like_, {static_cast<int64_t>(bytes)}, ScalarType::Byte);
      check_raster_launch(cuda::raster_bin(a_, mptr<uint8_t>(scratch), bytes,
                                           cptr<int64_t>(offsets_), scope_.stream()));
      check_raster_launch(cuda::raster_blend(a_, scope_.stream()));
    }

   private:
    const RasterArgs<T>& a_;
    const Tensor& like_;
    const Scope& scope_;
    Tensor offsets_;
    int64_t total_ = 0;
  };

  template <typename T>
  static void backward(const RasterGradArgs<T>& b, const Tensor& like, const Scope& scope) {
    Tensor grads = gsf::new_zeros(like, {b.forward.count, kGradFeatures + b.forward.features},
                                  scalar_type_of<T>());
    check_raster_launch(cuda::raster_backward(b, mptr<T>(grads), scope.stream()));
  }
};

}  // namespace
}  // namespace gsf

STABLE_TORCH_LIBRARY_IMPL(gsfluent, CUDA, m) {
  using Ops = gsf::RasterOps<gsf::RasterCuda>;
  m.impl("rasterize", TORCH_BOX(&Ops::forward));
  m.impl("rasterize_backward", TORCH_BOX(&Ops::backward));
}
