// return_mapping for the laws that are compiled apart (core/material/more_laws.h).
#include "cpu/material/plasticity_more.h"

#include <atomic>

#include "core/material/more_laws.h"
#include "torch_api.h"

namespace gsf {

template <typename T>
bool any_compiled_apart(const ReturnMappingArgs<T>& a) {
  for (int64_t row = 0; row < a.rows; ++row)
    if (compiled_apart(a.law[row], load_material(a.params + kParamColumns * row))) return true;
  return false;
}

template <typename T>
void return_mapping_more(const ReturnMappingArgs<T>& a) {
  const NaccOptions<T> options{a.k, a.epsilon, a.implicit_alpha};
  parallel_for(a.count, 512, [&](int64_t begin, int64_t end) {
    int32_t counts[4] = {0, 0, 0, 0};
    for (int64_t i = begin; i < end; ++i) {
      const int64_t row = a.material != nullptr ? a.material[i] : (a.rows == 1 ? 0 : i);
      const bool known = row >= 0 && row < a.rows;
      MaterialRow<T> material{};
      if (known) material = load_material(a.params + kParamColumns * row);
      const ReturnMapped<T> r = return_mapping_more(
          load_sym3(a.strain + 6 * i), a.alpha[i], load_mat3(a.increment + 9 * i),
          known ? a.law[row] : -1, material, options, a.dt);
      store_sym3(a.strain_out + 6 * i, r.strain);
      store_sym3(a.stress_out + 6 * i, r.stress);
      a.alpha_out[i] = r.alpha;
      counts[0] += r.plastic;
      counts[1] += r.guarded;
      counts[2] += r.inverted;
      counts[3] += r.invalid;
    }
    for (int c = 0; c < 4; ++c)
      std::atomic_ref<int32_t>(a.info[c]).fetch_add(counts[c], std::memory_order_relaxed);
  });
}

template bool any_compiled_apart(const ReturnMappingArgs<float>&);
template bool any_compiled_apart(const ReturnMappingArgs<double>&);
template void return_mapping_more(const ReturnMappingArgs<float>&);
template void return_mapping_more(const ReturnMappingArgs<double>&);

}  // namespace gsf
