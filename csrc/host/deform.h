// Checks, allocation and dtype dispatch of the deformation ops, once for both back ends.
#pragma once

#include "core/deform/args.h"
#include "torch_api.h"

namespace gsf {

template <class Backend>
struct DeformOps {
  static std::tuple<Tensor, Tensor> polar_clamped(const Tensor& deformation, double lo, double hi) {
    const char* op = "polar_clamped";
    check_shape(op, "deformation", deformation, {-1, 3, 3});
    STD_TORCH_CHECK(lo > 0 && hi >= lo, op, ": bounds must satisfy 0 < lo <= hi");
    const Tensor f = gsf::contiguous(deformation);
    const int64_t n = f.size(0);
    Tensor rotation = gsf::new_empty(f, {n, 3, 3}, f.scalar_type());
    Tensor clamped = gsf::new_empty(f, {n, 3, 3}, f.scalar_type());
    dispatch_floating(op, f, [&]<typename T>() {
      if (n == 0) return;
      const PolarArgs<T> args{n, cptr<T>(f), T(lo), T(hi), mptr<T>(rotation), mptr<T>(clamped)};
      Backend::polar(args, f);
    });
    return {rotation, clamped};
  }

  static std::tuple<Tensor, Tensor> covariance_axes(Tensor covariance) {
    const char* op = "covariance_axes";
    check_shape(op, "covariance", covariance, {-1, 6});
    covariance = gsf::contiguous(covariance);
    const int64_t n = covariance.size(0);
    Tensor quats = gsf::new_empty(covariance, {n, 4}, covariance.scalar_type());
    Tensor scales = gsf::new_empty(covariance, {n, 3}, covariance.scalar_type());
    dispatch_floating(op, covariance, [&]<typename T>() {
      if (n == 0) return;
      Backend::covariance_axes(
          CovarianceAxesArgs<T>{n, cptr<T>(covariance), mptr<T>(quats), mptr<T>(scales)},
          covariance);
    });
    return {quats, scales};
  }

  static std::tuple<Tensor, Tensor> carry_place(Tensor places, Tensor owner, Tensor near,
                                                Tensor parted, Tensor rest, Tensor position,
                                                Tensor map, Tensor width) {
    const char* op = "carry_place";
    check_shape(op, "places", places, {-1, 3});
    check_shape(op, "rest", rest, {-1, 3});
    check_shape(op, "near", near, {rest.size(0), -1});
    const int64_t count = places.size(0), points = rest.size(0), k = near.size(1);
    check_shape(op, "owner", owner, {count});
    check_shape(op, "parted", parted, {points, k});
    check_shape(op, "position", position, {points, 3});
    check_shape(op, "map", map, {points, 3, 3});
    check_shape(op, "width", width, {points});
    check_dtype(op, "owner", owner, ScalarType::Long);
    check_dtype(op, "near", near, ScalarType::Long);
    check_dtype(op, "parted", parted, ScalarType::Bool);
    for (Tensor* t : {&rest, &position, &map, &width})
      check_dtype(op, "every float tensor", *t, places.scalar_type());
    for (Tensor* t : {&places, &owner, &near, &parted, &rest, &position, &map, &width}) {
      check_same_device(op, "every tensor", *t, places);
      *t = gsf::contiguous(*t);
    }
    Tensor means = gsf::new_empty(places, {count, 3}, places.scalar_type());
    Tensor blend = gsf::new_empty(places, {count, 3, 3}, places.scalar_type());
    dispatch_floating(op, places, [&]<typename T>() {
      if (count == 0) return;
      const CarryPlaceArgs<T> args{count,
                                   points,
                                   static_cast<int>(k),
                                   cptr<T>(places),
                                   cptr<int64_t>(owner),
                                   cptr<int64_t>(near),
                                   cptr<bool>(parted),
                                   cptr<T>(rest),
                                   cptr<T>(position),
                                   cptr<T>(map),
                                   cptr<T>(width),
                                   mptr<T>(means),
                                   mptr<T>(blend)};
      Backend::carry_place(args, places);
    });
    return {means, blend};
  }

  static std::tuple<Tensor, Tensor> carry_axes(Tensor quats, Tensor scales, Tensor map,
                                               Tensor rotation, double rigid) {
    const char* op = "carry_axes";
    check_shape(op, "quats", quats, {-1, 4});
    const int64_t n = quats.size(0);
    check_shape(op, "scales", scales, {n, 3});
    check_shape(op, "map", map, {n, 3, 3});
    check_shape(op, "rotation", rotation, {n, 3, 3});
    for (Tensor* t : {&quats, &scales, &map, &rotation}) {
      check_dtype(op, "every tensor", *t, quats.scalar_type());
      check_same_device(op, "every tensor", *t, quats);
      *t = gsf::contiguous(*t);
    }
    Tensor new_quats = gsf::new_empty(quats, {n, 4}, quats.scalar_type());
    Tensor new_scales = gsf::new_empty(quats, {n, 3}, quats.scalar_type());
    dispatch_floating(op, quats, [&]<typename T>() {
      if (n == 0) return;
      const CarryAxesArgs<T> args{
          n,        cptr<T>(quats),     cptr<T>(scales),    cptr<T>(map), cptr<T>(rotation),
          T(rigid), mptr<T>(new_quats), mptr<T>(new_scales)};
      Backend::carry_axes(args, quats);
    });
    return {new_quats, new_scales};
  }
};

}  // namespace gsf
