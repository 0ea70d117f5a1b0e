// CUDA registration of activations and rules of shape.
#include "cuda/stream.h"
#include "cuda/train/activation_launch.h"
#include "host/activation.h"

namespace gsf {
namespace {

struct ActivationCuda {
  using Scope = CudaScope;
  GSF_LAUNCH(activate)
  GSF_LAUNCH(activate_backward)
  GSF_LAUNCH(clamp_aspect)
  GSF_LAUNCH(shorten_axes)
};

}  // namespace
}  // namespace gsf

GSF_REGISTER(CUDA, gsf::ActivationOps<gsf::ActivationCuda>)
