// Checks and dtype dispatch of the optimiser step, once for both back ends.
#pragma once

#include <cmath>

#include "core/train/adam.h"
#include "torch_api.h"

namespace gsf {

template <class Backend>
struct AdamOps {
  using Tensors = std::vector<Tensor>;

  static void check_state(const char* name, const Tensor& t, const Tensor& parameter) {
    const char* op = "adam_step";
    STD_TORCH_CHECK(t.dim() == parameter.dim() && t.numel() == parameter.numel(), op, ": ", name,
                    " must have the shape of its parameter, ", shape_string(parameter), ", got ",
                    shape_string(t));
    for (int64_t i = 0; i < t.dim(); ++i)
      STD_TORCH_CHECK(t.size(i) == parameter.size(i), op, ": ", name,
                      " must have the shape of its parameter, ", shape_string(parameter), ", got ",
                      shape_string(t));
    check_dtype(op, name, t, parameter.scalar_type());
    check_same_device(op, name, t, parameter);
    STD_TORCH_CHECK(t.is_contiguous(), op, ": ", name, " must be contiguous");
  }

  static void adam_step(const Tensors& parameters, const Tensors& gradients, const Tensors& first,
                        const Tensors& second, const std::vector<double>& rates, double beta1,
                        double beta2, double epsilon, int64_t step, const OptTensor& visible) {
    const char* op = "adam_step";
    const size_t count = parameters.size();
    STD_TORCH_CHECK(gradients.size() == count && first.size() == count && second.size() == count &&
                        rates.size() == count,
                    op, ": parameters, gradients, moments and rates must be equally many");
    STD_TORCH_CHECK(step >= 1, op, ": step must be at least 1, got ", step);
    STD_TORCH_CHECK(beta1 >= 0 && beta1 < 1 && beta2 >= 0 && beta2 < 1, op,
                    ": betas must lie in [0, 1)");
    if (count == 0) return;
    const Tensor& like = parameters[0];
    for (size_t i = 0; i < count; ++i) {
      STD_TORCH_CHECK(parameters[i].dim() >= 1, op, ": parameters must have at least one axis");
      check_dtype(op, "parameters", parameters[i], like.scalar_type());
      check_same_device(op, "parameters", parameters[i], like);
      check_state("parameters", parameters[i], parameters[i]);
      check_state("gradients", gradients[i], parameters[i]);
      check_state("first", first[i], parameters[i]);
      check_state("second", second[i], parameters[i]);
    }
    const AdamVisible seen = visible_rows(visible, parameters);
    const double correction1 = 1.0 - std::pow(beta1, double(step));
    const double root = 1.0 / std::sqrt(1.0 - std::pow(beta2, double(step)));
    const typename Backend::Scope scope(like);
    dispatch_floating(op, like, [&]<typename T>() {
      AdamArgs<T> args{};
      args.visible = seen;
      const auto flush = [&] {
        if (args.count > 0) Backend::adam_step(args, scope);
        args.count = 0;
      };
      for (size_t i = 0; i < count; ++i) {
        const Tensor& p = parameters[i];
        if (p.numel() == 0) continue;
        const AdamRates<T> constants{T(rates[i] / correction1),
                                     T(1.0 - beta1),
                                     T(1.0 - beta2),
                                     T(beta2),
                                     T(root),
                                     T(epsilon)};
        args.tensors[args.count++] = {
            mptr<T>(p), mptr<T>(first[i]),     mptr<T>(second[i]), cptr<T>(gradients[i]),
            p.size(0),  p.numel() / p.size(0), constants};
        if (args.count == kAdamTensors) flush();
      }
      flush();
    });
  }

  static AdamVisible visible_rows(const OptTensor& visible, const Tensors& parameters) {
    const char* op = "adam_step";
    if (!visible.has_value()) return {nullptr, nullptr};
    for (const Tensor& p : parameters) check_shape(op, "visible", *visible, {p.size(0)});
    check_same_device(op, "visible", *visible, parameters[0]);
    STD_TORCH_CHECK(visible->is_contiguous(), op, ": visible must be contiguous");
    if (visible->scalar_type() == ScalarType::Int) return {cptr<int32_t>(*visible), nullptr};
    STD_TORCH_CHECK(visible->scalar_type() == ScalarType::Bool, op,
                    ": visible must be bool or int32");
    return {nullptr, cptr<uint8_t>(*visible)};
  }

  static void register_all(Library& m) { GSF_IMPL(AdamOps, adam_step); }
};

}  // namespace gsf
