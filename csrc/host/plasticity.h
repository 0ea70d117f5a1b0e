// Checks, allocation and dtype dispatch of return_mapping and neo_hookean_energy, once for both
// back ends.
#pragma once

#include "core/material/return_mapping.h"
#include "torch_api.h"

namespace gsf {

// Row of each particle in a table of `rows` rows, int32 [N]; may be absent where there is one row
// or one for each.
inline OptTensor ready_material(const char* op, const OptTensor& material, int64_t rows,
                                const Tensor& strain) {
  const int64_t n = strain.size(0);
  STD_TORCH_CHECK(material || rows == 1 || rows == n, op,
                  ": without material, params must have 1 or N rows, got ", rows);
  return ready(op, "material", material, strain, {n}, ScalarType::Int);
}

template <class Backend>
struct PlasticityOps {
  static std::tuple<Tensor, Tensor, Tensor, Tensor> return_mapping(
      const Tensor& strain, const Tensor& alpha, const Tensor& increment, const Tensor& law,
      const Tensor& params, const OptTensor& material, double k, double epsilon, bool implicit,
      double dt, bool apart) {
    const char* op = "return_mapping";
    check_shape(op, "strain", strain, {-1, 6});
    const int64_t n = strain.size(0);
    const ScalarType dtype = strain.scalar_type();
    check_shape(op, "alpha", alpha, {n});
    check_shape(op, "increment", increment, {n, 3, 3});
    check_shape(op, "law", law, {-1});
    const int64_t rows = law.size(0);
    check_shape(op, "params", params, {rows, kParamColumns});
    check_dtype(op, "alpha", alpha, dtype);
    check_dtype(op, "increment", increment, dtype);
    check_dtype(op, "params", params, dtype);
    check_dtype(op, "law", law, ScalarType::Int);
    check_same_device(op, "alpha", alpha, strain);
    check_same_device(op, "increment", increment, strain);
    check_same_device(op, "law", law, strain);
    check_same_device(op, "params", params, strain);
    const OptTensor mat = ready_material(op, material, rows, strain);

    const Tensor e = gsf::contiguous(strain), a = gsf::contiguous(alpha),
                 inc = gsf::contiguous(increment), l = gsf::contiguous(law),
                 par = gsf::contiguous(params);
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
                                      .material = mat ? cptr<int32_t>(*mat) : nullptr,
                                      .k = T(k),
                                      .epsilon = T(epsilon),
                                      .implicit_alpha = implicit,
                                      .apart = apart,
                                      .dt = T(dt),
                                      .strain_out = mptr<T>(strain_out),
                                      .alpha_out = mptr<T>(alpha_out),
                                      .stress_out = mptr<T>(stress_out),
                                      .info = mptr<int32_t>(info)};
      Backend::return_mapping(args, scope);
    });
    return {strain_out, alpha_out, stress_out, info};
  }

  static Tensor neo_hookean_energy(const Tensor& strain, const Tensor& params,
                                   const OptTensor& material) {
    const char* op = "neo_hookean_energy";
    check_shape(op, "strain", strain, {-1, 6});
    const int64_t n = strain.size(0);
    const ScalarType dtype = strain.scalar_type();
    const Tensor e = gsf::contiguous(strain),
                 par = ready(op, "params", params, strain, {-1, kParamColumns});
    const int64_t rows = params.size(0);
    const OptTensor mat = ready_material(op, material, rows, strain);
    Tensor energy = gsf::new_empty(e, {n}, dtype);
    const typename Backend::Scope scope(e);
    dispatch_floating(op, e, [&]<typename T>() {
      if (n == 0) return;
      const StoredEnergyArgs<T> args{.count = n,
                                     .strain = cptr<T>(e),
                                     .rows = rows,
                                     .params = cptr<T>(par),
                                     .material = mat ? cptr<int32_t>(*mat) : nullptr,
                                     .energy = mptr<T>(energy)};
      Backend::neo_hookean_energy(args, scope);
    });
    return energy;
  }

  static void register_all(Library& m) {
    GSF_IMPL(PlasticityOps, return_mapping);
    GSF_IMPL(PlasticityOps, neo_hookean_energy);
  }
};

}  // namespace gsf
