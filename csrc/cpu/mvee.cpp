// CPU kernels of the enclosing-ellipsoid ops: fits in parallel, one thread each.
#include "host/mvee.h"

#include <atomic>
#include <vector>

#include "core/mvee/lens.h"
#include "core/mvee/mvee.h"

namespace gsf {
namespace {

// The largest value reported so far.
void report(int64_t* to, int64_t value) {
  const std::atomic_ref<int64_t> most(*to);
  int64_t seen = most.load();
  while (seen < value && !most.compare_exchange_weak(seen, value)) {
  }
}

struct MveeCpu {
  using Scope = CpuScope;
  template <typename T>
  static void mvee(const MveeArgs<T>& a, const Scope&) {
    parallel_for(a.batch, 1, [&](int64_t begin, int64_t end) {
      std::vector<FitPoint<T>> scratch(a.count);
      for (int64_t i = begin; i < end; ++i) {
        const Ellipsoid<T> fit =
            mvee_fit(SerialTeam{}, a.points + 3 * a.count * i, static_cast<int>(a.count),
                     scratch.data(), a.tolerance, a.max_iterations);
        store_vec3(a.center + 3 * i, fit.center);
        store_mat3(a.shape + 9 * i, to_mat3(fit.shape));
      }
    });
  }

  template <typename T>
  static void mvee_lens(const MveeLensArgs<T>& a, const Scope&) {
    parallel_for(a.batch, 16, [&](int64_t begin, int64_t end) {
      FitPoint<T> points[kLensPoints];
      for (int64_t i = begin; i < end; ++i) {
        const Vec3<T> mean_a = load_vec3(a.mean_a + 3 * i), mean_b = load_vec3(a.mean_b + 3 * i);
        const Sym3<T> cov_a = load_sym3(a.covariance_a + 6 * i);
        const Sym3<T> cov_b = load_sym3(a.covariance_b + 6 * i);
        const int fault_a = lens_fault(mean_a, cov_a), fault_b = lens_fault(mean_b, cov_b);
        if (fault_a != kSound) report(a.faults + fault_a, a.batch - i);
        if (fault_b != kSound) report(a.faults + kLensFaults + fault_b, a.batch - i);
        if (fault_a != kSound || fault_b != kSound) continue;
        const LensResult<T> r =
            gsf::mvee_lens(mean_a, cov_a, mean_b, cov_b, a.radius, a.flat, points);
        store_vec3(a.mean + 3 * i, r.mean);
        store_sym3(a.covariance + 6 * i, r.covariance);
        a.overlap[i] = r.overlap;
      }
    });
  }
};

}  // namespace
}  // namespace gsf

GSF_REGISTER(CPU, gsf::MveeOps<gsf::MveeCpu>)
