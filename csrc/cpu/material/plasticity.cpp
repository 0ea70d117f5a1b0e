// CPU kernel of return_mapping: particles in parallel, counters summed per range.
#include "host/plasticity.h"

#include <atomic>

#include "cpu/material/plasticity_more.h"

namespace gsf {

// phase_field.cpp: a file of its own, so that what gcc inlines here stays as it is.
template <typename T>
ReturnFlags phase_particle(const ReturnMappingArgs<T>& a, int64_t i);

namespace {

template <typename T>
bool is_phase(const ReturnMappingArgs<T>& a, int64_t i) {
  const int64_t row = a.material != nullptr ? a.material[i] : (a.rows == 1 ? 0 : i);
  return row >= 0 && row < a.rows && a.law[row] == kPhaseField;
}

struct PlasticityCpu {
  using Scope = CpuScope;
  template <typename T>
  static void return_mapping(const ReturnMappingArgs<T>& a, const Scope&) {
    if (any_compiled_apart(a)) return return_mapping_more(a);
    parallel_for(a.count, 512, [&](int64_t begin, int64_t end) {
      int32_t counts[4] = {0, 0, 0, 0};
      for (int64_t i = begin; i < end; ++i) {
        const ReturnFlags f =
            is_phase(a, i) ? phase_particle(a, i) : return_mapping_particle<false>(a, i);
        counts[0] += f.plastic;
        counts[1] += f.guarded;
        counts[2] += f.inverted;
        counts[3] += f.invalid;
      }
      for (int c = 0; c < 4; ++c)
        std::atomic_ref<int32_t>(a.info[c]).fetch_add(counts[c], std::memory_order_relaxed);
    });
  }
};

}  // namespace
}  // namespace gsf

GSF_REGISTER(CPU, gsf::PlasticityOps<gsf::PlasticityCpu>)
