// Checks, allocation and dtype dispatch of return_mapping, once for both back ends.
#pragma once

#include "core/material/return_mapping.h"
#include "torch_api.h"

namespace gsf {

template <class Backend>
struct PlasticityOps {
  static std::tuple<Tensor, Tensor, Tensor, Tensor> return_mapping(
      const Tensor& strain, const Tensor& alpha, const Tensor& increment, const Tensor& law,
      const Tensor& params, const OptTensor& material, double k, double epsilon, bool implicit,
      double dt) {
    const char* op = "return_mapping";
    const Tensor e = ready(op, "strain", strain, strain, {-1, 6});
    const int64_t n = e.size(0);
    const ScalarType dtype = e.scalar_type();
    const Tensor a = ready(op, "alpha", alpha, e, {n});
    const Tensor inc = ready(op, "increment", increment, e, {n, 3, 3});
    const Tensor l = ready(op, "law", law, e, {-1}, ScalarType::Int);
    const int64_t rows = l.size(0);
    const Tensor par = ready(op, "params", params, e, {rows, kParamColumns});
    const OptTensor mat = ready(op, "material", material, e, {n}, ScalarType::Int);
    STD_TORCH_CHECK(material || rows == 1 || rows == n, op,
                    ": without material, params must have 1 or N rows, got ", rows);
    Tensor strain_out = gsf::new_empty(e, {n, 6}, dtype);
    Tensor alpha_out = gsf::new_empty(e, {n}, dtype);
    Tensor stress_out = gsf::new_empty(e, {n, 6}, dtype);
    Tensor info = gsf::new_zeros(e, {4}, ScalarType::Int);
    const typename Backend::Scope scope(e);
    dispatch_floating(op, e, [&]<typename T>() {
      if (n == 0) return;
      const ReturnMappingArgs<T> args{.count = n,
                                      .strain = cptr<T>(e),
                                      .alpha = cptr<T>(a),
                                      .increment = cptr<T>(inc),
                                      .rows = rows,
                                      .law = cptr<int32_t>(l),
                                      .params = cptr<T>(par),
                                      .material = cptr<int32_t>(mat),
                                      .k = T(k),
                                      .epsilon = T(epsilon),
                                      .implicit_alpha = implicit,
                                      .dt = T(dt),
                                      .strain_out = mptr<T>(strain_out),
                                      .alpha_out = mptr<T>(alpha_out),
                                      .stress_out = mptr<T>(stress_out),
                                      .info = mptr<int32_t>(info)};
      Backend::return_mapping(args, scope);
    });
    return {strain_out, alpha_out, stress_out, info};
  }

  static void register_all(Library& m) { GSF_IMPL(PlasticityOps, return_mapping); }
};

}  // namespace gsf
