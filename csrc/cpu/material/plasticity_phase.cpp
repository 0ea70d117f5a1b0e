// CPU kernel of return_mapping for the law phase_field; called by plasticity.cpp.
#include "core/material/return_mapping.h"

namespace gsf {

template <typename T>
ReturnFlags phase_particle(const ReturnMappingArgs<T>& a, int64_t i) {
  return return_mapping_particle<true>(a, i);
}
template ReturnFlags phase_particle(const ReturnMappingArgs<float>&, int64_t);
template ReturnFlags phase_particle(const ReturnMappingArgs<double>&, int64_t);

}  // namespace gsf
