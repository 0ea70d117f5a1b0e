// Checks, allocation and dtype dispatch of the deformation ops, once for both back ends.
#pragma once

#include "core/material_args.h"
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
};

}  // namespace gsf
