// CPU kernel of return_mapping_adjoint: gradients of particles, and which of them it could not do.
#include "core/material/return_gradient.h"
#include "host/plasticity.h"

namespace gsf {
namespace {

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> return_mapping_adjoint(
    const Tensor& g_strain, const Tensor& g_alpha, const Tensor& g_stress, const Tensor& new_alpha,
    const Tensor& strain, const Tensor& alpha, const Tensor& increment, const Tensor& law,
    const Tensor& params, const OptTensor& material, double k, double epsilon, bool implicit) {
  const char* op = "return_mapping_adjoint";
  check_shape(op, "strain", strain, {-1, 6});
  const int64_t n = strain.size(0);
  const ScalarType dtype = strain.scalar_type();
  check_shape(op, "law", law, {-1});
  check_dtype(op, "law", law, ScalarType::Int);
  const int64_t rows = law.size(0);
  const auto ready = [&](const char* name, const Tensor& t, std::initializer_list<int64_t> shape) {
    check_shape(op, name, t, shape);
    check_dtype(op, name, t, dtype);
    check_same_device(op, name, t, strain);
    return gsf::contiguous(t);
  };
  const Tensor gs = ready("grad_strain", g_strain, {n, 6}), ga = ready("grad_alpha", g_alpha, {n}),
               gt = ready("grad_stress", g_stress, {n, 6}), na = ready("new_alpha", new_alpha, {n}),
               e = ready("strain", strain, {n, 6}), a = ready("alpha", alpha, {n}),
               inc = ready("increment", increment, {n, 3, 3}),
               par = ready("params", params, {rows, kParamColumns}), l = gsf::contiguous(law);
  const OptTensor mat = ready_material(op, material, rows, strain);
  const Tensor out_strain = new_zeros(e, {n, 6}, dtype), out_alpha = new_zeros(e, {n}, dtype),
               out_increment = new_zeros(e, {n, 3, 3}, dtype),
               out_params = new_zeros(e, {n, kGradientColumns}, dtype),
               done = new_zeros(e, {n}, ScalarType::Int);
  dispatch_floating(op, e, [&]<typename T>() {
    const T* row_of = cptr<T>(par);
    const int32_t* law_of = cptr<int32_t>(l);
    const int32_t* index = mat ? cptr<int32_t>(*mat) : nullptr;
    const NaccOptions<T> options{T(k), T(epsilon), implicit};
    const T *strains = cptr<T>(e), *alphas = cptr<T>(a), *increments = cptr<T>(inc),
            *news = cptr<T>(na), *g_strains = cptr<T>(gs), *g_alphas = cptr<T>(ga),
            *g_stresses = cptr<T>(gt);
    T *to_strain = mptr<T>(out_strain), *to_alpha = mptr<T>(out_alpha),
      *to_increment = mptr<T>(out_increment), *to_params = mptr<T>(out_params);
    int32_t* flags = mptr<int32_t>(done);
    parallel_for(n, 256, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) {
        const int64_t row = index != nullptr ? index[i] : (rows == 1 ? 0 : i);
        if (row < 0 || row >= rows) continue;
        ReturnGradient<T> g;
        if (!return_mapping_gradient(
                load_sym3(strains + 6 * i), alphas[i], load_mat3(increments + 9 * i), law_of[row],
                load_material(row_of + kParamColumns * row), options, news[i],
                load_sym3(g_strains + 6 * i), g_alphas[i], load_sym3(g_stresses + 6 * i), g))
          continue;
        flags[i] = 1;
        store_sym3(to_strain + 6 * i, g.strain);
        store_mat3(to_increment + 9 * i, g.increment);
        to_alpha[i] = g.alpha;
        for (int c = 0; c < kGradientColumns; ++c)
          to_params[kGradientColumns * i + c] = g.params[c];
      }
    });
  });
  return {out_strain, out_alpha, out_increment, out_params, done};
}

}  // namespace
}  // namespace gsf

STABLE_TORCH_LIBRARY_IMPL(gsfluent, CPU, m) { GSF_IMPL(gsf, return_mapping_adjoint); }
