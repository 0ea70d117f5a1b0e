// CUDA twin of csrc/cpu/info.cpp.
#include <cuda_runtime_api.h>

#include "cuda/stream.h"

namespace gsf {
namespace {
std::string compiled_for(const Tensor&) { return "cuda runtime " + std::to_string(CUDART_VERSION); }
}  // namespace
}  // namespace gsf

STABLE_TORCH_LIBRARY_IMPL(gsfluent, CUDA, m) { GSF_IMPL(gsf, compiled_for); }
