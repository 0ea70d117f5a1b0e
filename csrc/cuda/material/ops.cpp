// CUDA registration of return_mapping and neo_hookean_energy.
#include "cuda/material/launch.h"
#include "cuda/stream.h"
#include "host/plasticity.h"

namespace gsf {
namespace {

struct PlasticityCuda {
  using Scope = CudaScope;
  GSF_LAUNCH(return_mapping)
  GSF_LAUNCH(neo_hookean_energy)
};

}  // namespace
}  // namespace gsf

GSF_REGISTER(CUDA, gsf::PlasticityOps<gsf::PlasticityCuda>)
