// Which backend answers for a tensor's device: used by `gsfluent doctor` and by the build tests.
#include "torch_api.h"

namespace gsf {
namespace {
std::string compiled_for(const Tensor&) { return std::string("cpu ") + __VERSION__; }
}  // namespace
}  // namespace gsf

STABLE_TORCH_LIBRARY_IMPL(gsfluent, CPU, m) { GSF_IMPL(gsf, compiled_for); }
