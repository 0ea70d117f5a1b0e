// CUDA registration of the density ops.
#include "cuda/density/launch.h"
#include "cuda/stream.h"
#include "host/density.h"

namespace gsf {
namespace {

struct DensityCuda {
  using Scope = CudaScope;
  static constexpr bool kShares = true;
  GSF_LAUNCH(occupancy)
  GSF_LAUNCH(splat_bulk)
  GSF_LAUNCH(density_normals)
};

}  // namespace
}  // namespace gsf

GSF_REGISTER(CUDA, gsf::DensityOps<gsf::DensityCuda>)
