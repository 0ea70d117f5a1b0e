// Checks, allocation and dtype dispatch of activations and rules of shape, once for both back ends.
#pragma once

#include <cmath>

#include "core/train/activation.h"
#include "torch_api.h"

namespace gsf {

template <class Backend>
struct ActivationOps {
  using Values = std::tuple<Tensor, Tensor, Tensor>;
  using Slopes = std::tuple<Tensor, Tensor, Tensor, Tensor>;

  static int scale_columns(const char* op, int64_t columns) {
    STD_TORCH_CHECK(columns == 1 || columns == 3, op, ": scales must have 1 or 3 columns, got ",
                    columns);
    return static_cast<int>(columns);
  }

  static Values activate(const Tensor& scales, const Tensor& opacities, const Tensor& sh0,
                         const Tensor& sh_rest, int64_t degree) {
    const char* op = "activate";
    check_shape(op, "scales", scales, {-1, -1});
    const int64_t n = scales.size(0);
    const Tensor s = gsf::contiguous(scales), o = ready(op, "opacities", opacities, s, {n});
    const Tensor base = ready(op, "sh0", sh0, s, {n, 1, 3});
    const Tensor rest = ready(op, "sh_rest", sh_rest, s, {n, -1, 3});
    STD_TORCH_CHECK(degree >= 0 && degree <= 3 && (degree + 1) * (degree + 1) <= 1 + rest.size(1),
                    op, ": degree must lie in 0..3 and fit ", 1 + rest.size(1),
                    " coefficients, got ", degree);
    const int columns = scale_columns(op, s.size(1));
    const int coefficients = static_cast<int>((degree + 1) * (degree + 1));
    const auto dtype = s.scalar_type();
    Tensor out_s = gsf::new_empty(s, {n, 3}, dtype), out_o = gsf::new_empty(s, {n}, dtype);
    Tensor out_sh = gsf::new_empty(s, {n, coefficients, 3}, dtype);
    const typename Backend::Scope scope(s);
    dispatch_floating(op, s, [&]<typename T>() {
      const ActivationArgs<T> args{n,
                                   columns,
                                   static_cast<int>(rest.size(1)),
                                   coefficients,
                                   cptr<T>(s),
                                   cptr<T>(o),
                                   cptr<T>(base),
                                   cptr<T>(rest),
                                   mptr<T>(out_s),
                                   mptr<T>(out_o),
                                   mptr<T>(out_sh)};
      Backend::activate(args, scope);
    });
    return {out_s, out_o, out_sh};
  }

  static Slopes activate_backward(const Tensor& scales, const Tensor& opacities,
                                  const Tensor& grad_scales, const Tensor& grad_opacities,
                                  const Tensor& grad_sh, int64_t columns, int64_t rest, double size,
                                  double needle, double aspect, double opacity,
                                  const OptTensor& mark) {
    const char* op = "activate_backward";
    check_shape(op, "scales", scales, {-1, 3});
    const int64_t n = scales.size(0);
    const Tensor s = gsf::contiguous(scales), o = ready(op, "opacities", opacities, s, {n});
    const Tensor grad_s = ready(op, "grad_scales", grad_scales, s, {n, 3});
    const Tensor grad_o = ready(op, "grad_opacities", grad_opacities, s, {n});
    const Tensor grad_h = ready(op, "grad_sh", grad_sh, s, {n, -1, 3});
    STD_TORCH_CHECK(rest >= 0 && grad_h.size(1) >= 1 && grad_h.size(1) <= 1 + rest, op,
                    ": grad_sh must have 1 to ", 1 + rest, " coefficients, got ",
                    shape_string(grad_sh));
    if (mark) {
      check_shape(op, "mark", *mark, {});
      check_dtype(op, "mark", *mark, s.scalar_type());
      check_same_device(op, "mark", *mark, s);
    }
    const auto dtype = s.scalar_type();
    const int wide = scale_columns(op, columns);
    Tensor out_s = gsf::new_empty(s, {n, wide}, dtype), out_o = gsf::new_empty(s, {n}, dtype);
    Tensor out_0 = gsf::new_empty(s, {n, 1, 3}, dtype),
           out_r = gsf::new_empty(s, {n, rest, 3}, dtype);
    const typename Backend::Scope scope(s);
    dispatch_floating(op, s, [&]<typename T>() {
      const ActivationGradArgs<T> args{n,
                                       wide,
                                       static_cast<int>(rest),
                                       static_cast<int>(grad_h.size(1)),
                                       cptr<T>(s),
                                       cptr<T>(o),
                                       cptr<T>(grad_s),
                                       cptr<T>(grad_o),
                                       cptr<T>(grad_h),
                                       T(size),
                                       T(needle),
                                       T(aspect),
                                       T(opacity),
                                       mptr<T>(out_s),
                                       mptr<T>(out_o),
                                       mptr<T>(out_0),
                                       mptr<T>(out_r),
                                       mark ? mptr<T>(*mark) : nullptr};
      Backend::activate_backward(args, scope);
    });
    return {out_s, out_o, out_0, out_r};
  }

  static void clamp_aspect(const Tensor& scales, double most) {
    const char* op = "clamp_aspect";
    check_shape(op, "scales", scales, {-1, 3});
    STD_TORCH_CHECK(scales.is_contiguous(), op, ": scales must be contiguous");
    const typename Backend::Scope scope(scales);
    dispatch_floating(op, scales, [&]<typename T>() {
      Backend::clamp_aspect(AspectArgs<T>{scales.size(0), mptr<T>(scales), T(std::log(most))},
                            scope);
    });
  }

  static Tensor shorten_axes(const Tensor& means, const Tensor& quats, const Tensor& scales,
                             const Tensor& opacities, const Tensor& away,
                             const std::vector<double>& origin, double voxel, double overhang) {
    const char* op = "shorten_axes";
    check_shape(op, "means", means, {-1, 3});
    const int64_t n = means.size(0);
    const Tensor m = gsf::contiguous(means), q = ready(op, "quats", quats, m, {n, 4});
    const Tensor s = ready(op, "scales", scales, m, {n, 3});
    const Tensor o = ready(op, "opacities", opacities, m, {n});
    const Tensor field = ready(op, "away", away, m, {-1, -1, -1});
    STD_TORCH_CHECK(field.numel() > 0, op, ": away must hold a value");
    STD_TORCH_CHECK(origin.size() == 3 && voxel > 0, op,
                    ": origin must have three values, and voxel be positive");
    Tensor share = gsf::new_empty(m, {n, 3}, m.scalar_type());
    const typename Backend::Scope scope(m);
    dispatch_floating(op, m, [&]<typename T>() {
      const ShortenArgs<T> args{n,
                                cptr<T>(m),
                                cptr<T>(q),
                                cptr<T>(s),
                                cptr<T>(o),
                                {field.size(0), field.size(1), field.size(2)},
                                cptr<T>(field),
                                {T(origin[0]), T(origin[1]), T(origin[2])},
                                T(voxel),
                                T(overhang),
                                mptr<T>(share)};
      Backend::shorten_axes(args, scope);
    });
    return share;
  }

  static void register_all(Library& m) {
    GSF_IMPL(ActivationOps, activate);
    GSF_IMPL(ActivationOps, activate_backward);
    GSF_IMPL(ActivationOps, clamp_aspect);
    GSF_IMPL(ActivationOps, shorten_axes);
  }
};

}  // namespace gsf
