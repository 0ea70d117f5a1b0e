// CPU back end of the collider operators.
#include "host/collider.h"

namespace gsf {
namespace {

struct ColliderCpu {
  using Scope = CpuScope;
  template <typename T>
  static void collider_distance(const ColliderDistanceArgs<T>& a, const Scope&) {
    parallel_for(a.points * a.rows, 256, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) a.compute(i);
    });
  }
  template <typename T>
  static void advance_colliders(const AdvanceCollidersArgs<T>& a, const Scope&) {
    for (int64_t c = 0; c < a.rows; ++c) a.compute(c);
  }
  template <typename T>
  static void blade_sides(const BladeSidesArgs<T>& a, const Scope&) {
    parallel_for(a.points, 1024, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) a.compute(i);
    });
  }
};

}  // namespace
}  // namespace gsf

GSF_REGISTER(CPU, gsf::ColliderOps<gsf::ColliderCpu>)
