// CPU kernel of return_mapping: particles in parallel, counters summed per range.
#include "host/plasticity.h"

#include <atomic>

#include "cpu/material/plasticity_more.h"

namespace gsf {
namespace {

struct PlasticityCpu {
  using Scope = CpuScope;
  template <typename T>
  static void return_mapping(const ReturnMappingArgs<T>& a, const Scope&) {
    if (any_compiled_apart(a)) return return_mapping_more(a);
    parallel_for(a.count, 512, [&](int64_t begin, int64_t end) {
      int32_t counts[4] = {0, 0, 0, 0};
      for (int64_t i = begin; i < end; ++i) {
        const ReturnFlags f = return_mapping_particle(a, i);
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
