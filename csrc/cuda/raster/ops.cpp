// The rasterizer's CUDA backend: scratch from torch's allocator, registration.
#include "cuda/raster/launch.h"
#include "cuda/stream.h"
#include "host/raster.h"

namespace gsf {
namespace {

struct RasterCuda {
  using Scope = CudaScope;
  static constexpr int kTile = cuda::kListTile;
  static constexpr bool kSavesOrder = false, kWritesGradients = true;
  static int stride(int features) { return cuda::kGeometry + features; }

  template <typename T>
  static void check(const RasterArgs<T>& a) {
    constexpr int kMostCameras = 65535;  // of a launch's grid
    STD_TORCH_CHECK(a.cameras <= kMostCameras, kRasterOp, ": at most ", kMostCameras,
                    " cameras at once, got ", a.cameras);
    STD_TORCH_CHECK(reinterpret_cast<uintptr_t>(a.splats) % 16 == 0, kRasterOp,
                    ": saved state does not belong to these inputs (not aligned)");
  }

  template <typename T>
  class Plan {
   public:
    Plan(const RasterArgs<T>& a, const Tensor& like, const Scope& scope)
        : a_(a), like_(like), scope_(scope), number_(cuda::read_back(scope.index())) {
      check(a);
      const size_t bytes = cuda::raster_order_scratch(a.splat_count());
      scratch_ = gsf::new_empty(like, {static_cast<int64_t>(bytes)}, ScalarType::Byte);
      order_ = cuda::carve_raster_order(mptr<uint8_t>(scratch_), a.splat_count());
      check_cuda(kRasterOp, cuda::raster_project(a, order_, number_, scope.stream()));
      // Sorted while the host waits for the number of list entries, which projection knows.
      check_cuda(kRasterOp, cuda::raster_sort(order_, a.splat_count(), scope.stream()));
    }

    int64_t instance_count() const {
      int64_t count = 0;
      check_cuda(kRasterOp, cuda::await_count(number_, &count));
      return count;
    }

    void blend() {
      const int64_t tiles = int64_t(a_.tiles()) * a_.cameras;
      const size_t bytes =
          a_.instance_count > 0 ? cuda::raster_bin_scratch(a_.instance_count, tiles) : 0;
      Tensor scratch = gsf::new_empty(like_, {static_cast<int64_t>(bytes)}, ScalarType::Byte);
      check_cuda(kRasterOp,
                 cuda::raster_bin(a_, order_, mptr<uint8_t>(scratch), bytes, scope_.stream()));
      Tensor units =
          gsf::new_empty(like_, {a_.contribution ? a_.count : int64_t(0)}, ScalarType::Long);
      check_cuda(kRasterOp, cuda::raster_blend(a_, mptr<int64_t>(units), scope_.stream()));
    }

   private:
    const RasterArgs<T>& a_;
    const Tensor& like_;
    const Scope& scope_;
    cuda::ReadBack* number_;
    Tensor scratch_;
    cuda::RasterOrder order_;
  };

  template <typename T>
  static void backward(const RasterGradArgs<T>& b, const Tensor& like, const Scope& scope) {
    check(b.forward);
    Tensor own = gsf::new_empty(like, {cuda::raster_sums_size(b)}, scalar_type_of<T>());
    Tensor fixed = gsf::new_empty(like, {cuda::raster_fixed_size(b)}, ScalarType::Long);
    Tensor background =
        gsf::new_empty(like, {cuda::raster_background_size(b)}, scalar_type_of<T>());
    const cuda::SplatSums<T> sums =
        cuda::raster_sums(b, own.numel() > 0 ? mptr<T>(own) : nullptr,
                          fixed.numel() > 0 ? mptr<int64_t>(fixed) : nullptr);
    check_cuda(kRasterOp, cuda::raster_backward(b, sums, mptr<T>(background), scope.stream()));
  }
};

}  // namespace
}  // namespace gsf

GSF_REGISTER(CUDA, gsf::RasterOps<gsf::RasterCuda>)
