// CPU kernels of the deformation ops.
#include "host/deform.h"

#include "core/deform/carry.h"

namespace gsf {
namespace {

struct DeformCpu {
  using Scope = CpuScope;
  template <typename T>
  static void polar_clamped(const PolarArgs<T>& a, const Scope&) {
    parallel_for(a.count, 256, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) {
        Mat3<T> rotation, clamped;
        gsf::polar_clamped(load_mat3(a.deformation + 9 * i), a.lo, a.hi, rotation, clamped);
        store_mat3(a.rotation + 9 * i, rotation);
        store_mat3(a.clamped + 9 * i, clamped);
      }
    });
  }
  template <typename T>
  static void covariance_axes(const CovarianceAxesArgs<T>& a, const Scope&) {
    parallel_for(a.count, 256, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) gsf::covariance_axes(a, i);
    });
  }
  template <typename T>
  static void carry_place(const CarryPlaceArgs<T>& a, const Scope&) {
    parallel_for(a.count, 256, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) gsf::carry_place(a, i);
    });
  }
  template <typename T>
  static void carry_axes(const CarryAxesArgs<T>& a, const Scope&) {
    parallel_for(a.count, 256, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) gsf::carry_axes(a, i);
    });
  }
};

}  // namespace
}  // namespace gsf

GSF_REGISTER(CPU, gsf::DeformOps<gsf::DeformCpu>)
