// CPU kernels of the deformation ops.
#include "host/deform.h"

#include "core/deform/carry.h"

namespace gsf {
namespace {

struct DeformCpu {
  template <typename T>
  static void polar(const PolarArgs<T>& a, const Tensor&) {
    parallel_for(a.count, 256, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) {
        Mat3<T> rotation, clamped;
        polar_clamped(load_mat3(a.deformation + 9 * i), a.lo, a.hi, rotation, clamped);
        store_mat3(a.rotation + 9 * i, rotation);
        store_mat3(a.clamped + 9 * i, clamped);
      }
    });
  }
  template <typename T>
  static void covariance_axes(const CovarianceAxesArgs<T>& a, const Tensor&) {
    parallel_for(a.count, 256, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) gsf::covariance_axes(a, i);
    });
  }
  template <typename T>
  static void carry_place(const CarryPlaceArgs<T>& a, const Tensor&) {
    parallel_for(a.count, 256, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) gsf::carry_place(a, i);
    });
  }
  template <typename T>
  static void carry_axes(const CarryAxesArgs<T>& a, const Tensor&) {
    parallel_for(a.count, 256, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) gsf::carry_axes(a, i);
    });
  }
};

}  // namespace
}  // namespace gsf

STABLE_TORCH_LIBRARY_IMPL(gsfluent, CPU, m) {
  m.impl("polar_clamped", TORCH_BOX(&gsf::DeformOps<gsf::DeformCpu>::polar_clamped));
  m.impl("covariance_axes", TORCH_BOX(&gsf::DeformOps<gsf::DeformCpu>::covariance_axes));
  m.impl("carry_place", TORCH_BOX(&gsf::DeformOps<gsf::DeformCpu>::carry_place));
  m.impl("carry_axes", TORCH_BOX(&gsf::DeformOps<gsf::DeformCpu>::carry_axes));
}
