// CUDA registration of the spatial ops.
#include "cuda/spatial/launch.h"
#include "cuda/stream.h"
#include "host/spatial.h"

namespace gsf {
namespace {

struct SpatialCuda {
  using Scope = CudaScope;
  GSF_LAUNCH(nearest_labels)
  GSF_LAUNCH(largest_shares)
  GSF_LAUNCH(nearest_points)
  GSF_LAUNCH(box_sum)
  GSF_LAUNCH(distance_pass)
  GSF_LAUNCH(trilinear)
  GSF_LAUNCH(value_noise)
  GSF_LAUNCH(hashes)
  GSF_LAUNCH(label_boxes)
  GSF_LAUNCH(margin_counts)
};

}  // namespace
}  // namespace gsf

GSF_REGISTER(CUDA, gsf::SpatialOps<gsf::SpatialCuda>)
