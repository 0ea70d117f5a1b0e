// Adjoint of the constitutive step of one particle, for the laws elastic and nacc where no guard
// acted. Tensor algebra by hand; the scalar map of NACC (J^2 - 1, |d|, alpha, material) -> (alpha',
// r, J'^2 - 1) by dual numbers through core/material/nacc.h itself, the implicit alpha by the
// implicit function theorem at the root the forward pass found.
#pragma once

#include "core/dual.h"
#include "core/material/return_mapping.h"

namespace gsf {

inline constexpr int kGradientColumns = 6;  // mu, kappa, M, beta, xi, eta

// Adjoint of one particle: of its inputs and of its material row.
template <typename T>
struct ReturnGradient {
  Sym3<T> strain;
  Mat3<T> increment;
  T alpha;
  T params[kGradientColumns];
};

// sum of products of the six components (off-diagonal ones once): gradient times change.
template <typename T>
GSF_HOST_DEVICE T dot6(const Sym3<T>& a, const Sym3<T>& b) {
  return a.xx * b.xx + a.yy * b.yy + a.zz * b.zz + a.xy * b.xy + a.xz * b.xz + a.yz * b.yz;
}

// Six components of a gradient <-> symmetric S with dL = tr(S dB).
template <typename T>
GSF_HOST_DEVICE Sym3<T> halved(const Sym3<T>& g) {
  return {g.xx, g.yy, g.zz, T(0.5) * g.xy, T(0.5) * g.xz, T(0.5) * g.yz};
}
template <typename T>
GSF_HOST_DEVICE Sym3<T> doubled(const Sym3<T>& s) {
  return {s.xx, s.yy, s.zz, T(2) * s.xy, T(2) * s.xz, T(2) * s.yz};
}

// Derivative of the determinant with respect to the matrix (symmetric like it).
template <typename T>
GSF_HOST_DEVICE Sym3<T> cofactors(const Sym3<T>& a) {
  return {a.yy * a.zz - a.yz * a.yz, a.xx * a.zz - a.xz * a.xz, a.xx * a.yy - a.xy * a.xy,
          a.xz * a.yz - a.xy * a.zz, a.xy * a.yz - a.xz * a.yy, a.xy * a.xz - a.xx * a.yz};
}

// Adjoint of e' = (I + A)(I + e)(I + A)^T - I.
template <typename T>
GSF_HOST_DEVICE void pull_back_strain(const Sym3<T>& g, const Sym3<T>& e, const Mat3<T>& a,
                                      ReturnGradient<T>& out) {
  const Mat3<T> push = a + identity3<T>();
  const Mat3<T> through = matmul(to_mat3(halved(g)), push);
  const Mat3<T> before = matmul(transpose(push), through);
  out.strain = doubled(
      Sym3<T>{before(0, 0), before(1, 1), before(2, 2), T(0.5) * (before(0, 1) + before(1, 0)),
              T(0.5) * (before(0, 2) + before(2, 0)), T(0.5) * (before(1, 2) + before(2, 1))});
  out.increment = T(2) * matmul(through, to_mat3(add_diagonal(e, T(1))));
}

// Derivatives of NACC's (alpha', r, J'^2 - 1) with respect to the nine inputs of `kInputs`.
inline constexpr int kNaccInputs = 9;  // J^2 - 1, |d|, alpha, mu, kappa, M, beta, xi, eta
template <typename T>
struct NaccSlopes {
  T r, j2m1;  // values
  T d_alpha[kNaccInputs], d_r[kNaccInputs], d_j2m1[kNaccInputs];
};

template <typename T>
GSF_HOST_DEVICE NaccSlopes<T> nacc_slopes(const MaterialRow<T>& row, const NaccOptions<T>& o,
                                          const ElasticState<T>& s, T alpha, T new_alpha) {
  using D = Dual<T, kNaccInputs + 1>;  // the last direction is the alpha of the surface
  const NaccMaterial<D> m{D::variable(row.mu, 3),        D::variable(row.kappa, 4),
                          D::variable(row.strength, 5),  D::variable(row.cohesion, 6),
                          D::variable(row.hardening, 7), D::variable(row.damage, 8)};
  const NaccOptions<D> options{D(o.k), D(o.epsilon), o.implicit_alpha};
  const D volume = D::variable(s.j2m1, 0), n = D::variable(s.n, 1);
  const D p = D(T(-0.5)) * m.kappa * volume;
  const D q = D(T(1.224744871391589)) * m.mu * n;
  const NaccTrial<D> trial{p, q, n, D(T(0.5)) * log1p(volume)};
  const D before = D::variable(alpha, 2);
  D after;
  NaccReturn<D> ret;
  if (o.implicit_alpha) {
    after = D(new_alpha);
    // At a limit of alpha the surface moves no further.
    if (new_alpha > T(kAlphaMin) && new_alpha < T(kAlphaMax)) {
      const D x = D::variable(new_alpha, kNaccInputs);
      const D f = alpha_residual(m, options, trial, before, x);
      const T slope = f.d[kNaccInputs];
      const T inverse = slope > T(1e-6) || slope < T(-1e-6) ? T(1) / slope : T(1);
      for (int i = 0; i < kNaccInputs; ++i) after.d[i] = -inverse * f.d[i];
    }
    ret = nacc_project(m, options, yield_surface(m, after), p, q);
  } else {
    ret = nacc_project(m, options, yield_surface(m, before), p, q);
    after = clamp(before + alpha_step(m, trial, ret), D(T(kAlphaMin)), D(T(kAlphaMax)));
  }
  const D j2m1 = D(T(-2)) * ret.p / m.kappa;
  NaccSlopes<T> out;
  out.r = ret.r.v;
  out.j2m1 = j2m1.v;
  for (int i = 0; i < kNaccInputs; ++i) {
    out.d_alpha[i] = after.d[i];
    out.d_r[i] = ret.r.d[i];
    out.d_j2m1[i] = j2m1.d[i];
  }
  return out;
}

// Adjoint of strain' = J'^(2/3) (m I + d') - I with det(m I + d') = 1: adds to the gradients of d'
// and J'^2 - 1.
template <typename T>
GSF_HOST_DEVICE void pull_back_rebuilt(const Sym3<T>& g, const Sym3<T>& d, T j2m1, Sym3<T>& g_d,
                                       T& g_j2m1) {
  using std::cbrt;
  const T y = unit_det_shift(d);
  const T h = T(0.5) * norm2(d);
  const T slope = (T(3) * y + T(6)) * y + (T(3) - h);
  const T scale = cbrt(T(1) + j2m1);  // J'^(2/3)
  const T g_trace = trace(g);
  const T g_y = scale * g_trace / (slope > T(0) ? slope : T(1));
  g_d = g_d + scale * g + (g_y * (T(1) + y)) * doubled(d) + (-g_y) * doubled(cofactors(d));
  const T g_scale = dot6(g, d) + (T(1) + y) * g_trace;
  g_j2m1 += g_scale * scale / (T(3) * (T(1) + j2m1));
}

// False, and nothing in `out`, when the particle is none of the cases above: another law, a guard
// acted, not finite, alpha outside its range.
template <typename T>
GSF_HOST_DEVICE bool return_mapping_gradient(const Sym3<T>& strain, T alpha,
                                             const Mat3<T>& increment, int law,
                                             const MaterialRow<T>& m, const NaccOptions<T>& o,
                                             T new_alpha, const Sym3<T>& g_strain, T g_alpha,
                                             const Sym3<T>& g_stress, ReturnGradient<T>& out) {
  if (law != kElastic && law != kNacc) return false;
  const Sym3<T> e = update_strain(strain, increment);
  if (!finite(e) || !finite(alpha)) return false;
  if (!(det_identity_plus(increment) > T(0))) return false;
  const ElasticState<T> s = elastic_state(e, false);
  if (s.guarded) return false;
  for (int i = 0; i < kGradientColumns; ++i) out.params[i] = T(0);
  out.alpha = g_alpha;
  bool plastic = false;
  if (law == kNacc) {
    if (!(alpha >= T(kAlphaMin) && alpha <= T(kAlphaMax))) return false;
    const NaccMaterial<T> nacc{m.mu, m.kappa, m.strength, m.cohesion, m.hardening, m.damage};
    if (nacc.shear_damage < T(0)) {
      if (!rankine_clearly_elastic(nacc, s, alpha)) return false;
    }
    T u, w;
    normalized(nacc, yield_surface(nacc, alpha), T(-0.5) * m.kappa * s.j2m1,
               T(1.224744871391589) * m.mu * s.n, u, w);
    plastic = !(nacc.shear_damage < T(0)) &&
              u * u + w * w > T(1) + (sizeof(T) == 4 ? T(1e-6) : T(2e-15));
  }

  const T pressed = T(0.5) * trace(g_stress);
  Sym3<T> g_e{T(0), T(0), T(0), T(0), T(0), T(0)}, g_d = m.mu * g_stress;
  T g_j2m1 = T(0);
  if (plastic) {
    const NaccSlopes<T> map = nacc_slopes(m, o, s, alpha, new_alpha);
    const Sym3<T> d = map.r * s.d;
    T g_new = m.kappa * pressed;
    pull_back_rebuilt(g_strain, d, map.j2m1, g_d, g_new);
    const T g_r = dot6(g_d, s.d);
    T g_in[kNaccInputs];
    for (int i = 0; i < kNaccInputs; ++i)
      g_in[i] = g_alpha * map.d_alpha[i] + g_r * map.d_r[i] + g_new * map.d_j2m1[i];
    g_d = map.r * g_d;
    if (s.n > T(0)) g_d = g_d + (g_in[1] / s.n) * doubled(s.d);
    g_j2m1 = g_in[0];
    out.alpha = g_in[2];
    for (int i = 0; i < kGradientColumns; ++i) out.params[i] = g_in[3 + i];
    if (m.strength < T(kFrictionMin)) out.params[2] = T(0);  // friction is off, not small
    out.params[0] += dot6(g_stress, d);
    out.params[1] += pressed * map.j2m1;
  } else {
    g_e = g_strain;
    g_j2m1 = m.kappa * pressed;
    out.params[0] = dot6(g_stress, s.d);
    out.params[1] = pressed * s.j2m1;
  }
  // d = J^(-2/3) dev e, J^2 = det(I + e)
  const T j2 = T(1) + s.j2m1;
  g_j2m1 -= dot6(g_d, s.d) / (T(3) * j2);
  g_e = g_e + s.isochoric * deviator(g_d) + g_j2m1 * doubled(cofactors(add_diagonal(e, T(1))));
  pull_back_strain(g_e, strain, increment, out);
  return true;
}

}  // namespace gsf
