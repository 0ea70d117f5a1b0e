// CPU kernel of softening_paths: whole paths of the return map, one row after the other.
#include <limits>

#include "host/plasticity.h"

namespace gsf {
namespace {

// The work of the stress until the strength is gone, NaN where it never is; what is strained then.
double soften(const double* params, double alpha, double stretch, double first, int64_t steps,
              double* left) {
  const int32_t law = kNacc;
  double strain[6] = {}, stress[6] = {}, work = 0.0;
  double increment[9] = {first};
  int32_t info[4] = {};
  const ReturnMappingArgs<double> a{.count = 1,
                                    .strain = strain,
                                    .alpha = &alpha,
                                    .increment = increment,
                                    .rows = 1,
                                    .law = &law,
                                    .params = params,
                                    .material = nullptr,
                                    .k = 2.0,
                                    .epsilon = 0.1,
                                    .implicit_alpha = true,
                                    .apart = false,
                                    .dt = 0.0,
                                    .strain_out = strain,
                                    .alpha_out = &alpha,
                                    .stress_out = stress,
                                    .info = info};
  for (int64_t step = 0; step < steps; ++step) {
    const double before = stress[0];
    return_mapping_particle<false>(a, 0);
    work += 0.5 * (before + stress[0]) * stretch / double(steps);
    if (alpha >= 0.0) {
      for (int c = 0; c < 6; ++c) left[c] = strain[c];
      return work;
    }
  }
  return std::numeric_limits<double>::quiet_NaN();
}

std::tuple<Tensor, Tensor> softening_paths(const Tensor& params, const Tensor& alpha,
                                           const Tensor& stretch, const Tensor& first,
                                           int64_t steps) {
  const char* op = "softening_paths";
  const Tensor par = ready(op, "params", params, params, {-1, kParamColumns}, ScalarType::Double);
  const int64_t n = params.size(0);
  const Tensor a = ready(op, "alpha", alpha, params, {n}, ScalarType::Double),
               s = ready(op, "stretch", stretch, params, {n}, ScalarType::Double),
               f = ready(op, "first", first, params, {n}, ScalarType::Double);
  STD_TORCH_CHECK(steps >= 1, op, ": steps must be at least 1, got ", steps);
  const Tensor work = new_zeros(par, {n}, ScalarType::Double);
  const Tensor left = new_zeros(par, {n, 6}, ScalarType::Double);
  double *sum = mptr<double>(work), *strain = mptr<double>(left);
  parallel_for(n, 8, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i)
      sum[i] = soften(cptr<double>(par) + kParamColumns * i, cptr<double>(a)[i], cptr<double>(s)[i],
                      cptr<double>(f)[i], steps, strain + 6 * i);
  });
  return {work, left};
}

}  // namespace
}  // namespace gsf

STABLE_TORCH_LIBRARY_IMPL(gsfluent, CPU, m) { GSF_IMPL(gsf, softening_paths); }
