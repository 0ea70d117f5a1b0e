// Laws that are compiled apart from those of laws.h, so that loops over the latter stay as they
// are: Yeoh's and Ogden's rubber, and von Mises matter that flows with a viscosity, softens as it
// flows, or hardens by a power and by its rate. Definition: ops/reference/rubber.py and laws.py;
// equations: docs/theory/laws.md.
#pragma once

#include "core/material/return_mapping.h"

namespace gsf {

// Numbers that `Law` leaves out.
enum MoreLaw : int { kYeoh = 7, kOgden = 8 };

// Whether laws.h does not know it. Columns of a row of von Mises: `damage` is the plastic viscosity
// [Pa s], and `hardening` may be below zero; with an `exponent` see power_von_mises.
template <typename T>
GSF_HOST_DEVICE bool compiled_apart(int law, const MaterialRow<T>& m) {
  return law == kYeoh || law == kOgden ||
         (law == kVonMises && (m.damage > T(0) || m.hardening < T(0) || m.exponent > T(0)));
}

// --- Yeoh: W = C10 x + C20 x^2 + C30 x^3, x = J^(-2/3) tr b - 3, C10 = mu / 2 ---
// Columns: strength is C20 [Pa], cohesion is C30 [Pa]. Yeoh 1993.

// 2 dW/dx
template <typename T>
GSF_HOST_DEVICE T yeoh_modulus(const MaterialRow<T>& m, T x) {
  return m.mu + x * (T(4) * m.strength + x * (T(6) * m.cohesion));
}

template <typename T>
GSF_HOST_DEVICE LawResult<T> yeoh(const MaterialRow<T>& m, const Sym3<T>& e, T alpha,
                                  bool inverted) {
  const ElasticState<T> s = elastic_state(e, inverted);
  LawResult<T> out{s.e, s.e, alpha, false, s.guarded};
  if (s.guarded) out.strain = strain_from_isochoric(s.d, log_volume(s));
  const T x = T(3) * unit_det_shift(s.d);
  out.stress = kirchhoff_stress(yeoh_modulus(m, x), m.kappa, s.d, s.j2m1);
  return out;
}

// --- Ogden: W = sum mu_p / a_p (l1^a_p + l2^a_p + l3^a_p - 3) of isochoric stretches ---
// Columns: strength a_1, cohesion mu_2 [Pa], hardening a_2, damage mu_3 [Pa], exponent a_3; mu_1
// from 2 mu = sum mu_p a_p. Ogden 1972.

template <typename T>
struct OgdenTerms {
  T modulus[3], power[3];
};

template <typename T>
GSF_HOST_DEVICE OgdenTerms<T> ogden_terms(const MaterialRow<T>& m) {
  const T first = (T(2) * m.mu - m.cohesion * m.hardening - m.damage * m.exponent) / m.strength;
  return {{first, m.cohesion, m.damage}, {m.strength, m.hardening, m.exponent}};
}

template <typename T>
GSF_HOST_DEVICE LawResult<T> ogden(const MaterialRow<T>& m, const Sym3<T>& e, T alpha,
                                   bool inverted) {
  using std::expm1;
  const HenckyState<T> h = hencky_state(e, inverted);
  const OgdenTerms<T> terms = ogden_terms(m);
  Sym3<T> sum{};
  for (int p = 0; p < 3; ++p)
    if (terms.modulus[p] != T(0))
      sum = sum + terms.modulus[p] * exp_minus_identity(terms.power[p] * h.dev);
  return {h.e, add_diagonal(deviator(sum), T(0.5) * m.kappa * expm1(T(2) * h.log_j)), alpha, false,
          h.guarded};
}

// --- von Mises with plastic viscosity and softening ---
// The overstress y = |s| - sqrt(2/3) (sigma_y + H alpha) drives the flow: eta times the plastic
// strain rate is what is left of it, s' = |s| - y / (1 + eta / (2 mu_hat dt)) where H = 0, with
// mu_hat = mu tr(b) / 3 (Yue et al. 2015, Li et al. 2023). Without a step (dt = 0) nothing flows.
// H < 0 lowers the yield stress to zero at most.

template <typename T>
GSF_HOST_DEVICE LawResult<T> viscous_von_mises(const MaterialRow<T>& m, const Sym3<T>& e, T alpha,
                                               bool inverted, T dt) {
  const T root = T(0.816496580927726);  // sqrt(2/3)
  const HenckyState<T> h = hencky_state(e, inverted);
  const T before = max(alpha, T(0));
  const T limit = root * max(m.strength + m.hardening * before, T(0));
  const T slack = sizeof(T) == 4 ? T(4e-6) : T(1e-14);
  const T trial = T(2) * m.mu * h.n;
  const bool flows = trial > limit + slack * (limit + T(0.25) * m.mu * max(h.log_j, -h.log_j)) &&
                     (dt > T(0) || m.damage == T(0));
  if (!flows) return {h.e, hencky_stress(m, h.dev, h.log_j), before, false, h.guarded};
  const T mean = T(1) + trace(h.e) * T(1.0 / 3.0);
  const T drag = m.damage > T(0) ? m.damage / (mean * dt) : T(0);
  const T y = trial - limit;
  T slip = y / (T(2) * m.mu + T(2.0 / 3.0) * m.hardening + drag);
  // What softens to nothing within the step: the rest of the flow meets no yield stress.
  if (m.hardening < T(0) && m.strength + m.hardening * (before + root * slip) < T(0))
    slip = trial / (T(2) * m.mu + drag);
  const Sym3<T> dev = max(T(1) - slip / h.n, T(0)) * h.dev;
  return {strain_from_hencky(dev, h.log_j), hencky_stress(m, dev, h.log_j), before + root * slip,
          true, h.guarded};
}

// --- von Mises with the hardening, rate and heating of Johnson and Cook ---
// sigma_y = (A + B a^n) (1 + C ln(rate / 1 s^-1)) exp(-W / Q), the logarithm not below 0, W the
// plastic work of the strain a at this rate: their 1 - T* with the exponent 1, where all heat stays
// (d(1 - T*) / da = -sigma_y / Q). Columns: strength A [Pa], hardening B [Pa], exponent n, cohesion
// C, damage Q [J/m^3], 0 without heating. Johnson and Cook 1983.

template <typename T>
GSF_HOST_DEVICE T power_yield(const MaterialRow<T>& m, T strain, T rate) {
  using std::exp;
  using std::log;
  using std::pow;
  const T grown = strain > T(0) ? m.hardening * pow(strain, m.exponent) : T(0);
  const T faster = rate > T(1) ? T(1) + m.cohesion * log(rate) : T(1);
  T yield = faster * (m.strength + grown);
  if (m.damage > T(0))
    yield *= exp(-faster * strain * (m.strength + grown / (T(1) + m.exponent)) / m.damage);
  return yield;
}

// |s'| = |s| - 2 mu x = sqrt(2/3) sigma_y(a + sqrt(2/3) x) for the flow x between 0 and |s| / 2 mu,
// by a bracket that false position (Illinois) or halving makes smaller. Without a step no rate is
// known, and what hangs on one stays.
template <typename T>
GSF_HOST_DEVICE LawResult<T> power_von_mises(const MaterialRow<T>& m, const Sym3<T>& e, T alpha,
                                             bool inverted, T dt) {
  const T root = T(0.816496580927726);  // sqrt(2/3)
  const HenckyState<T> h = hencky_state(e, inverted);
  const T before = max(alpha, T(0));
  const T limit = root * power_yield(m, before, T(0));
  const T slack = sizeof(T) == 4 ? T(4e-6) : T(1e-14);
  const T trial = T(2) * m.mu * h.n;
  const bool flows = trial > limit + slack * (limit + T(0.25) * m.mu * max(h.log_j, -h.log_j)) &&
                     (dt > T(0) || m.cohesion == T(0));
  if (!flows) return {h.e, hencky_stress(m, h.dev, h.log_j), before, false, h.guarded};
  const auto excess = [&](T x) {
    const T rate = dt > T(0) ? root * x / dt : T(0);
    return trial - T(2) * m.mu * x - root * power_yield(m, before + root * x, rate);
  };
  T low = T(0), high = h.n, below = trial - limit, above = excess(high);
  const T fine = sizeof(T) == 4 ? T(2e-7) : T(4e-16);
  int side = 0;
  for (int i = 0; i < 100 && high - low > fine * high; ++i) {
    T x = (low * above - high * below) / (above - below);
    if (!(x > low && x < high) || i % 8 == 7) x = T(0.5) * (low + high);
    const T f = excess(x);
    if (f > T(0)) {
      low = x;
      below = f;
      if (side == 1) above *= T(0.5);
      side = 1;
    } else {
      high = x;
      above = f;
      if (side == -1) below *= T(0.5);
      side = -1;
      if (f == T(0)) break;
    }
  }
  const Sym3<T> dev = max(T(1) - high / h.n, T(0)) * h.dev;
  return {strain_from_hencky(dev, h.log_j), hencky_stress(m, dev, h.log_j), before + root * high,
          true, h.guarded};
}

// return_mapping for every law there is.
template <typename T>
GSF_HOST_DEVICE ReturnMapped<T> return_mapping_more(const Sym3<T>& strain, T alpha,
                                                    const Mat3<T>& increment, int law,
                                                    const MaterialRow<T>& m,
                                                    const NaccOptions<T>& o, T dt) {
  const Sym3<T> e = update_strain(strain, increment);
  if (!compiled_apart(law, m) || !finite(e) || !finite(alpha))
    return return_mapping(strain, alpha, increment, law, m, o, dt);
  const bool inverted = !(det_identity_plus(increment) > T(0));
  const LawResult<T> r = law == kYeoh        ? yeoh(m, e, alpha, inverted)
                         : law == kOgden     ? ogden(m, e, alpha, inverted)
                         : m.exponent > T(0) ? power_von_mises(m, e, alpha, inverted, dt)
                                             : viscous_von_mises(m, e, alpha, inverted, dt);
  return {r.strain, r.stress, r.alpha, r.plastic, r.guarded, inverted, false};
}

// return_mapping_particle for every law there is.
template <typename T>
GSF_HOST_DEVICE ReturnFlags return_mapping_particle_more(const ReturnMappingArgs<T>& a, int64_t i) {
  const int64_t row = a.material != nullptr ? a.material[i] : (a.rows == 1 ? 0 : i);
  const bool known = row >= 0 && row < a.rows;
  MaterialRow<T> material{};
  if (known) material = load_material(a.params + kParamColumns * row);
  const ReturnMapped<T> r = return_mapping_more(
      load_sym3(a.strain + 6 * i), a.alpha[i], load_mat3(a.increment + 9 * i),
      known ? a.law[row] : -1, material, NaccOptions<T>{a.k, a.epsilon, a.implicit_alpha}, a.dt);
  store_sym3(a.strain_out + 6 * i, r.strain);
  store_sym3(a.stress_out + 6 * i, r.stress);
  a.alpha_out[i] = r.alpha;
  return {r.plastic, r.guarded, r.inverted, r.invalid};
}

// --- wave speeds, as in wave_speed.h ---

// With W' = dW/dx and d the isochoric deviator, d tau_i / d h_i - tau_i has 4 W'' d_i^2 beside the
// terms of the neo-Hookean law with the modulus 2 W' of now.
template <typename T>
GSF_HOST_DEVICE T yeoh_wave_squared(const MaterialRow<T>& m, const Sym3<T>& e) {
  const ElasticState<T> s = elastic_state(e, false);
  const T x = T(3) * unit_det_shift(s.d);
  const T mu = max(yeoh_modulus(m, x), T(0));
  const T bend = max(T(8) * m.strength + T(24) * m.cohesion * x, T(0));  // 4 W''
  const T mean = T(1) + x * T(1.0 / 3.0);
  const T largest2 = T(2.0 / 3.0) * s.n * s.n;  // of the eigenvalues of a deviator
  const T along = mu * (T(4.0 / 3.0) * mean + T(0.272165526975909) * s.n) + bend * largest2 +
                  T(0.5) * m.kappa * (T(2) + s.j2m1);
  const T across = mu * (mean + T(0.816496580927726) * s.n);
  return max(along, across) / m.density;
}

// Of the principal stretches: g_i = sum mu_p a_p l_i^a_p along an axis is 4/9 g_i + 1/9 (g_j +
// g_k).
template <typename T>
GSF_HOST_DEVICE T ogden_wave_squared(const MaterialRow<T>& m, const Sym3<T>& e) {
  using std::abs;
  using std::exp;
  using std::expm1;
  using std::log1p;
  const OgdenTerms<T> terms = ogden_terms(m);
  const ElasticState<T> s = elastic_state(e, false);
  const Sym3<T> kept = s.guarded ? strain_from_isochoric(s.d, log_volume(s)) : s.e;
  const Vec3<T> x = eigenvalues(kept);
  const T log_j = log_volume(s);
  T g[3], stress[3], square[3], sum = T(0), all = T(0), most = T(0), least = T(0);
  for (int i = 0; i < 3; ++i) {
    const T xi = i == 0 ? x.x : (i == 1 ? x.y : x.z);
    const T h = T(0.5) * log1p(max(xi, T(-0.9999))) - T(1.0 / 3.0) * log_j;
    g[i] = stress[i] = T(0);
    square[i] = exp(T(2) * h);
    for (int p = 0; p < 3; ++p) {
      if (terms.modulus[p] == T(0)) continue;
      const T grown = expm1(terms.power[p] * h);
      stress[i] += terms.modulus[p] * grown;
      g[i] += terms.modulus[p] * terms.power[p] * (T(1) + grown);
    }
    all += g[i];
    sum += stress[i];
    most = max(most, g[i]);
  }
  for (int i = 0; i < 3; ++i) least = min(least, stress[i] - T(1.0 / 3.0) * sum);
  T fastest = T(1.0 / 3.0) * most + T(1.0 / 9.0) * all - least + T(0.5) * m.kappa * (T(2) + s.j2m1);
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      const T gap = square[i] - square[j];
      const bool equal = abs(gap) < T(1e-3) * square[i];
      const T ratio = equal ? T(0.5) * max(g[i], g[j])
                            : (stress[i] - stress[j]) / gap * max(square[i], square[j]);
      fastest = max(fastest, ratio);
    }
  return fastest / m.density;
}

template <typename T>
GSF_HOST_DEVICE T wave_speed_squared_more(int law, const MaterialRow<T>& m, const Sym3<T>& strain) {
  if (law != kYeoh && law != kOgden) return wave_speed_squared(law, m, strain);
  if (!finite(strain)) return T(0);
  return law == kYeoh ? yeoh_wave_squared(m, strain) : ogden_wave_squared(m, strain);
}

}  // namespace gsf
