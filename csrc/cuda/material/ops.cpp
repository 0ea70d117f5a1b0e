// CUDA registration of return_mapping.
#include "cuda/material/launch.h"
#include "cuda/stream.h"
#include "host/plasticity.h"

namespace gsf {
namespace {

struct PlasticityCuda {
  using Scope = CudaScope;
  GSF_LAUNCH(return_mapping)
};

}  // namespace
}  // namespace gsf

GSF_REGISTER(CUDA, gsf::PlasticityOps<gsf::PlasticityCuda>)
