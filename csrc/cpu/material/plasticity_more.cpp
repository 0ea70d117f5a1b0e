// CPU kernel of return_mapping for the laws that are compiled apart (core/material/more_laws.h);
// called by plasticity.cpp.
#include "core/material/more_laws.h"

namespace gsf {

template <typename T>
bool any_compiled_apart(const ReturnMappingArgs<T>& a) {
  for (int64_t row = 0; row < a.rows; ++row)
    if (compiled_apart(a.law[row], load_material(a.params + kParamColumns * row))) return true;
  return false;
}

template <typename T>
bool more_particle(const ReturnMappingArgs<T>& a, int64_t i, ReturnFlags& flags) {
  const int64_t row = a.material != nullptr ? a.material[i] : (a.rows == 1 ? 0 : i);
  if (row < 0 || row >= a.rows) return false;
  const MaterialRow<T> material = load_material(a.params + kParamColumns * row);
  if (!compiled_apart(a.law[row], material)) return false;
  const ReturnMapped<T> r = return_mapping_more(
      load_sym3(a.strain + 6 * i), a.alpha[i], load_mat3(a.increment + 9 * i), a.law[row], material,
      NaccOptions<T>{a.k, a.epsilon, a.implicit_alpha}, a.dt);
  store_sym3(a.strain_out + 6 * i, r.strain);
  store_sym3(a.stress_out + 6 * i, r.stress);
  a.alpha_out[i] = r.alpha;
  flags = {r.plastic, r.guarded, r.inverted, r.invalid};
  return true;
}

template bool any_compiled_apart(const ReturnMappingArgs<float>&);
template bool any_compiled_apart(const ReturnMappingArgs<double>&);
template bool more_particle(const ReturnMappingArgs<float>&, int64_t, ReturnFlags&);
template bool more_particle(const ReturnMappingArgs<double>&, int64_t, ReturnFlags&);

}  // namespace gsf
