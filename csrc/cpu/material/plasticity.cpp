// CPU kernel of return_mapping: particles in parallel, counters summed per range.
#include "host/plasticity.h"

#include <atomic>

namespace gsf {

// Files of their own, so that what gcc inlines here stays as it is. Their names sort behind this
// one: of a function that several files hold, the linker keeps the first copy.
// plasticity_phase.cpp:
template <typename T>
ReturnFlags phase_particle(const ReturnMappingArgs<T>& a, int64_t i);
// plasticity_more.cpp; more_particle tells whether the particle was one of theirs:
template <typename T>
bool any_compiled_apart(const ReturnMappingArgs<T>& a);
template <typename T>
bool more_particle(const ReturnMappingArgs<T>& a, int64_t i, ReturnFlags& flags);
// plasticity_stored.cpp:
template <typename T>
void stored_energies(const StoredEnergyArgs<T>& a, int64_t begin, int64_t end);

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
    const bool more = any_compiled_apart(a);
    parallel_for(a.count, 512, [&](int64_t begin, int64_t end) {
      int32_t counts[4] = {0, 0, 0, 0};
      for (int64_t i = begin; i < end; ++i) {
        ReturnFlags f;
        if (!more || !more_particle(a, i, f))
          f = is_phase(a, i) ? phase_particle(a, i) : return_mapping_particle<false>(a, i);
        counts[0] += f.plastic;
        counts[1] += f.guarded;
        counts[2] += f.inverted;
        counts[3] += f.invalid;
      }
      for (int c = 0; c < 4; ++c)
        std::atomic_ref<int32_t>(a.info[c]).fetch_add(counts[c], std::memory_order_relaxed);
    });
  }
  template <typename T>
  static void neo_hookean_energy(const StoredEnergyArgs<T>& a, const Scope&) {
    parallel_for(a.count, 512, [&](int64_t begin, int64_t end) { stored_energies(a, begin, end); });
  }
};

}  // namespace
}  // namespace gsf

GSF_REGISTER(CPU, gsf::PlasticityOps<gsf::PlasticityCpu>)
