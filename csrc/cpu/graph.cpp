// CPU kernels of the ops on graphs.
#include "host/graph.h"

#include <algorithm>
#include <atomic>

namespace gsf {
namespace {

struct GraphCpu {
  using Scope = CpuScope;

  static void link_costs(const LinkCostsArgs& a, const Scope&) {
    parallel_for(a.links.count, 4096, [&](int64_t begin, int64_t end) {
      int64_t one, two;
      for (int64_t l = begin; l < end; ++l)
        if (link_cost(a, l, &one, &two))
          for (const int64_t point : {one, two})  // of two threads both write the same
            std::atomic_ref<bool>(a.torn_end[point]).store(true, std::memory_order_relaxed);
    });
  }

  // Union-find with halved paths (Tarjan 1984): roots are hooked onto smaller ones.
  static void components(const ComponentsArgs& a, const Scope&) {
    int64_t* root = a.root;
    for (int64_t i = 0; i < a.links.points; ++i) root[i] = i;
    const auto find = [root](int64_t i) {
      while (root[i] != i) i = root[i] = root[root[i]];
      return i;
    };
    int64_t one, two;
    for (int64_t l = 0; l < a.links.count; ++l) {
      if (!a.joins(l, &one, &two)) continue;
      const int64_t first = find(one), second = find(two);
      root[std::max(first, second)] = std::min(first, second);
    }
    // no root is larger than what hangs on it
    for (int64_t i = 0; i < a.links.points; ++i) root[i] = root[root[i]];
  }

  // Sweeps there and back over the links that lead anywhere, until nothing changes.
  static void nearest_seeds(const NearestSeedsArgs& a, const Scope&) {
    int64_t leading = 0, one, two;
    for (int64_t l = 0; l < a.links.count; ++l)
      if (a.leads(l, &one, &two)) a.leading[leading++] = l;
    bool changed = leading > 0;
    const auto relax = [&](int64_t l) {
      a.links.ends(l, &one, &two);
      int64_t &first = a.key[one], &second = a.key[two];
      const int64_t there = a.offer(l, first, two, second), back = a.offer(l, second, one, first);
      changed = changed || there < second || back < first;
      second = std::min(second, there);
      first = std::min(first, back);
    };
    while (changed) {
      changed = false;
      for (int64_t k = 0; k < leading; ++k) relax(a.leading[k]);
      for (int64_t k = leading; k-- > 0;) relax(a.leading[k]);
    }
  }
};

}  // namespace
}  // namespace gsf

GSF_REGISTER(CPU, gsf::GraphOps<gsf::GraphCpu>)
