// CPU kernel of return_mapping for the laws that are compiled apart (core/material/more_laws.h);
// called by plasticity.cpp.
#include "core/material/more_laws.h"

namespace gsf {

template <typename T>
bool any_compiled_apart(const ReturnMappingArgs<T>& a) {
  if (!a.apart) return false;
  for (int64_t row = 0; row < a.rows; ++row)
    if (compiled_apart(a.law[row], load_material(a.params + kParamColumns * row))) return true;
  return false;
}

template <typename T>
bool more_particle(const ReturnMappingArgs<T>& a, int64_t i, ReturnFlags& flags) {
  const int64_t row = a.material != nullptr ? a.material[i] : (a.rows == 1 ? 0 : i);
  if (row < 0 || row >= a.rows) return false;
  if (!compiled_apart(a.law[row], load_material(a.params + kParamColumns * row))) return false;
  flags = return_mapping_particle_more(a, i);
  return true;
}

template bool any_compiled_apart(const ReturnMappingArgs<float>&);
template bool any_compiled_apart(const ReturnMappingArgs<double>&);
template bool more_particle(const ReturnMappingArgs<float>&, int64_t, ReturnFlags&);
template bool more_particle(const ReturnMappingArgs<double>&, int64_t, ReturnFlags&);

}  // namespace gsf
