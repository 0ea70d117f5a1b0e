// Checks, allocation and dtype dispatch of the enclosing-ellipsoid ops, once for both back ends.
#pragma once

#include "core/mvee/args.h"
#include "torch_api.h"

namespace gsf {

template <class Backend>
struct MveeOps {
  static std::tuple<Tensor, Tensor> mvee(const Tensor& points, double tolerance,
                                         int64_t max_iterations) {
    const char* op = "mvee";
    check_shape(op, "points", points, {-1, -1, 3});
    const Tensor x = gsf::contiguous(points);
    const int64_t batch = x.size(0), count = x.size(1);
    STD_TORCH_CHECK(batch == 0 || count > 0, op, ": points must hold at least one point per set");
    STD_TORCH_CHECK(count <= INT32_MAX && max_iterations >= 0 && max_iterations <= INT32_MAX, op,
                    ": counts must fit 32 bits");
    const ScalarType dtype = x.scalar_type();
    Tensor center = gsf::new_empty(x, {batch, 3}, dtype);
    Tensor shape = gsf::new_empty(x, {batch, 3, 3}, dtype);
    const typename Backend::Scope scope(x);
    dispatch_floating(op, x, [&]<typename T>() {
      if (batch == 0) return;
      const MveeArgs<T> args{.batch = batch,
                             .count = count,
                             .points = cptr<T>(x),
                             .tolerance = tolerance,
                             .max_iterations = static_cast<int>(max_iterations),
                             .center = mptr<T>(center),
                             .shape = mptr<T>(shape)};
      Backend::mvee(args, scope);
    });
    return {center, shape};
  }

  static std::tuple<Tensor, Tensor, Tensor, Tensor> mvee_lens(const Tensor& mean_a,
                                                              const Tensor& covariance_a,
                                                              const Tensor& mean_b,
                                                              const Tensor& covariance_b,
                                                              double radius, double flat) {
    const char* op = "mvee_lens";
    check_shape(op, "mean_a", mean_a, {-1, 3});
    const int64_t batch = mean_a.size(0);
    const ScalarType dtype = mean_a.scalar_type();
    check_shape(op, "covariance_a", covariance_a, {batch, 6});
    check_shape(op, "mean_b", mean_b, {batch, 3});
    check_shape(op, "covariance_b", covariance_b, {batch, 6});
    check_dtype(op, "covariance_a", covariance_a, dtype);
    check_dtype(op, "mean_b", mean_b, dtype);
    check_dtype(op, "covariance_b", covariance_b, dtype);
    check_same_device(op, "covariance_a", covariance_a, mean_a);
    check_same_device(op, "mean_b", mean_b, mean_a);
    check_same_device(op, "covariance_b", covariance_b, mean_a);
    const Tensor ma = gsf::contiguous(mean_a), ca = gsf::contiguous(covariance_a),
                 mb = gsf::contiguous(mean_b), cb = gsf::contiguous(covariance_b);
    Tensor mean = gsf::new_empty(ma, {batch, 3}, dtype);
    Tensor covariance = gsf::new_empty(ma, {batch, 6}, dtype);
    Tensor overlap = gsf::new_empty(ma, {batch}, ScalarType::Bool);
    // Reported and not checked here, so that the caller decides when to wait for the device.
    Tensor faults = gsf::new_zeros(ma, {6}, ScalarType::Long);
    const typename Backend::Scope scope(ma);
    dispatch_floating(op, ma, [&]<typename T>() {
      if (batch == 0) return;
      const MveeLensArgs<T> args{.batch = batch,
                                 .mean_a = cptr<T>(ma),
                                 .covariance_a = cptr<T>(ca),
                                 .mean_b = cptr<T>(mb),
                                 .covariance_b = cptr<T>(cb),
                                 .radius = radius,
                                 .flat = flat,
                                 .mean = mptr<T>(mean),
                                 .covariance = mptr<T>(covariance),
                                 .overlap = mptr<bool>(overlap),
                                 .faults = mptr<int64_t>(faults)};
      Backend::mvee_lens(args, scope);
    });
    return {mean, covariance, overlap, faults};
  }

  static void register_all(Library& m) {
    GSF_IMPL(MveeOps, mvee);
    GSF_IMPL(MveeOps, mvee_lens);
  }
};

}  // namespace gsf
