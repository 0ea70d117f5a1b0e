// CUDA registration of the deformation ops.
#include "cuda/deform/launch.h"
#include "cuda/stream.h"
#include "host/deform.h"

namespace gsf {
namespace {

struct DeformCuda {
  using Scope = CudaScope;
  GSF_LAUNCH(polar_clamped)
  GSF_LAUNCH(covariance_axes)
  GSF_LAUNCH(carry_place)
  GSF_LAUNCH(carry_axes)
  GSF_LAUNCH(quats_to_matrices)
  GSF_LAUNCH(matrices_to_quats)
  GSF_LAUNCH(quat_products)
  GSF_LAUNCH(link_states)
  GSF_LAUNCH(find_faces)
  GSF_LAUNCH(face_elements)
  GSF_LAUNCH(cut_at_cells)
  GSF_LAUNCH(cut_by_planes)
};

}  // namespace
}  // namespace gsf

GSF_REGISTER(CUDA, gsf::DeformOps<gsf::DeformCuda>)
