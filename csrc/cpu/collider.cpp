// CPU back end of the collider operators.
#include "host/collider.h"

namespace gsf {
namespace {

struct Cpu {
  struct Scope {
    explicit Scope(const Tensor&) {}
  };
  template <typename T>
  static void distance(const ColliderDistanceArgs<T>& a, const Scope&) {
    parallel_for(a.points * a.rows, 256, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) a.compute(i);
    });
  }
  template <typename T>
  static void advance(const AdvanceCollidersArgs<T>& a, const Scope&) {
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

STABLE_TORCH_LIBRARY_IMPL(gsfluent, CPU, m) { gsf::ColliderOps<gsf::Cpu>::register_all(m); }
