// CUDA registration of the ops of a texture's synthesis.
#include "cuda/stream.h"
#include "cuda/texture/launch.h"
#include "host/texture.h"

namespace gsf {
namespace {

struct TextureCuda {
  using Scope = CudaScope;
  static constexpr bool kRows = true;
  GSF_LAUNCH(rows_between)
  GSF_LAUNCH(quantile_shift)
  GSF_LAUNCH(patch_votes)
};

}  // namespace
}  // namespace gsf

GSF_REGISTER(CUDA, gsf::TextureOps<gsf::TextureCuda>)
