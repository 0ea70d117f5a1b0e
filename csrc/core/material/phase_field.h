// Phase-field fracture: what one point does between two damage solves. Bourdin, Francfort and
// Marigo 2000; the split of Amor, Marigo and Maurini 2009 or Miehe, Hofacker and Welschinger 2010,
// and Miehe's history. docs/theory/phase-field.md.
//
//   energy   g(d) psi+ + psi-,   g = (1 - k)(1 - d)^2 + k
//   alpha    H / psi_t - 1, the largest psi+ so far over the threshold: below zero while nothing
//            can be damaged (AT1)
//
// The damage d comes with the row (column `cohesion`): it is a field, and the solver's to find.
#pragma once

#include "core/material/laws.h"

namespace gsf {

inline constexpr double kResidualStiffness = 1e-4;  // k
inline constexpr double kBrokenDamage = 0.95;       // d of a broken point: peak = d - 0.95
inline constexpr double kDriveMax = 1e4;            // of H / psi_t: 1 - d is 1e-4 there
// Broken matter forgets what it has opened and sheared beyond these, as torn liquid does: the
// stiffness that is left must not pull across an open crack.
inline constexpr double kBrokenVolumeMax = 0.44;                // J^2 - 1 of J = 1.2
inline constexpr double kBrokenLogMax = 0.36464311358790924;    // its logarithm
inline constexpr double kBrokenIsochoric = 0.8855488076521759;  // J^(-2/3) there
inline constexpr double kBrokenShearMax = 0.5;                  // |d|
constexpr bool isochoric_is(double isochoric, double j2m1) {
  const double off = isochoric * isochoric * isochoric * (1.0 + j2m1) - 1.0;
  return off < 1e-14 && off > -1e-14;
}
static_assert(isochoric_is(kBrokenIsochoric, kBrokenVolumeMax));

// Column `damage` of a row: split, and 4 for AT2.
enum EnergySplit : int {
  kSplitVolumetric = 0,
  kSplitNone = 1,
  kSplitSpectral = 2,
  kSplitRankine = 3  // as kSplitSpectral, but the largest tensile stress drives
};
inline constexpr int kModelAt2 = 4;
template <typename T>
GSF_HOST_DEVICE int split_of(const MaterialRow<T>& m) {
  return int(m.damage) & 3;
}
template <typename T>
GSF_HOST_DEVICE bool is_principal(const MaterialRow<T>& m) {
  return split_of(m) >= kSplitSpectral;
}
template <typename T>
GSF_HOST_DEVICE bool is_at2(const MaterialRow<T>& m) {
  return (int(m.damage) & kModelAt2) != 0;
}

// Damage of a point with this peak.
template <typename T>
GSF_HOST_DEVICE T damage_of(T peak) {
  return clamp(peak + T(kBrokenDamage), T(0), T(1));
}

// Whether the damage of a point is solved for: it has some, or is near its threshold.
inline constexpr double kActiveDrive = 0.5, kActiveDriveAt2 = 1e-3;  // H / psi_t
template <typename T>
GSF_HOST_DEVICE T active_alpha(bool at2) {
  return T((at2 ? kActiveDriveAt2 : kActiveDrive) - 1.0);
}
template <typename T>
GSF_HOST_DEVICE bool takes_part(T alpha, T peak, T active) {
  return alpha > active || peak > T(-kBrokenDamage);
}

// Whether fewer terms and steps do: in float, on the GPU (on the CPU a pack does what a number
// does).
#ifdef __CUDA_ARCH__
template <typename T>
inline constexpr bool kFewDigits = sizeof(T) == 4;
#else
template <typename T>
inline constexpr bool kFewDigits = false;
#endif

// x - ln(1 + x) of x = J^2 - 1 between these, by the series of the inverse hyperbolic tangent of
// z = x / (2 + x): x - 2 z is x z, so that nothing cancels.
inline constexpr double kSeriesPressed = -0.3, kSeriesOpen = 0.45;
template <typename T>
GSF_HOST_DEVICE T volume_series(T x) {
  const T z = x / (T(2) + x), square = z * z;
  constexpr int kTerms = kFewDigits<T> ? 11 : 25;
  T sum = T(1.0 / double(kTerms));
  for (int n = kTerms - 2; n >= 3; n -= 2) sum = T(1.0 / double(n)) + square * sum;
  return z * (x - T(2) * square * sum);
}

// Root y of det((1 + y) I + d) = 1 for |d| up to a half, by Newton's steps (core/sym3.h): the first
// is off by 5e-3 of it, the second by 1e-5, the third by 1e-10.
template <typename T>
GSF_HOST_DEVICE T unit_det_shift_small(const Sym3<T>& d) {
  const T h = T(0.5) * norm2(d);
  const T c = h - det(d);
  T y = c / (T(3) - h);
  for (int i = 0; i < (kFewDigits<T> ? 2 : 4); ++i) {
    const T f = ((y + T(3)) * y + (T(3) - h)) * y - c;
    y -= f / ((T(3) * y + T(6)) * y + (T(3) - h));
  }
  return y;
}

// Without branches, for numbers and for packs of them: psi+ and the Kirchhoff stress of the splits
// `volumetric` (all = 0) and `none` (all = 1).
template <typename T>
struct PhaseState {
  T active;  // psi+
  Sym3<T> stress;
};
template <typename T, typename Volume>
GSF_HOST_DEVICE PhaseState<T> phase_state(T mu, T kappa, T damage, T all, const Sym3<T>& d, T shift,
                                          T j2m1, const Volume& volume_energy) {
  const T whole = T(1) - damage;
  const T g = T(1.0 - kResidualStiffness) * whole * whole + T(kResidualStiffness);
  const T open = max(j2m1, T(0)), pressed = min(j2m1, T(0));
  const T counted = open + all * pressed;
  return {T(1.5) * mu * shift + T(0.25) * kappa * volume_energy(counted),
          add_diagonal(g * mu * d, T(0.5) * kappa * (g * counted + (T(1) - all) * pressed))};
}

// What phase_state_spectral takes of a number; of packs of them cpu/solver/principal.h.
template <typename T>
struct PrincipalOfNumber {
  GSF_HOST_DEVICE Vec3<T> eigenvalues(const Sym3<T>& e) const { return eigenvalues_jacobi(e); }
  GSF_HOST_DEVICE T half_log(T x) const {  // ln(1 + x) / 2
    using std::log1p;
    return T(0.5) * log1p(x);
  }
  GSF_HOST_DEVICE T log_over(T y) const { return log1p_over(y); }
  GSF_HOST_DEVICE T pick(bool which, T yes, T no) const { return which ? yes : no; }
};

// Split by the principal Hencky strains h: psi+ = mu sum <h_i>^2 + lambda/2 <tr h>^2. kSplitRankine
// (rankine 1, else 0) has <largest principal stress over g>^2 / 2E in the place of psi+ as what
// drives.
template <typename T, typename Of>
GSF_HOST_DEVICE PhaseState<T> phase_state_spectral(T mu, T kappa, T damage, T rankine,
                                                   const Sym3<T>& e, const Of& of) {
  const Vec3<T> found = of.eigenvalues(e);
  const T least = T(kEigenvalueMin - 1.0);
  const T x[3] = {max(found.x, least), max(found.y, least), max(found.z, least)};
  T h[3], up[3], all[2], tension[2];
  for (int i = 0; i < 3; ++i) {
    h[i] = of.half_log(x[i]);
    up[i] = max(h[i], T(0));
  }
  for (int i = 0; i < 2; ++i) {  // divided differences of h and of <h>, largest eigenvalue first
    const T apart = x[i] - x[i + 1], b = T(1) + x[i + 1];
    all[i] = T(0.5) * of.log_over(apart / b) / b;
    tension[i] = of.pick(h[i + 1] >= T(0), all[i], of.pick(apart > T(0), up[i] / apart, T(0)));
  }
  const T span = x[0] - x[2];
  // Below it the second differences overflow, and what they multiply is nothing.
  const T all2 = of.pick(span > T(1e-30), (all[0] - all[1]) / span, T(0));
  const T tension2 = of.pick(span > T(1e-30), (tension[0] - tension[1]) / span, T(0));
  // Newton's polynomial f1 + f12 (e - x1) + f123 (e - x1)(e - x2).
  const Sym3<T> first = add_diagonal(e, T(0) - x[0]);
  const Sym3<T> second = square(first) + (x[0] - x[1]) * first;
  const Sym3<T> log_v = add_diagonal(all[0] * first + all2 * second, h[0]);
  const Sym3<T> plus = add_diagonal(tension[0] * first + tension2 * second, up[0]);
  const T whole = T(1) - damage;
  const T g = T(1.0 - kResidualStiffness) * whole * whole + T(kResidualStiffness);
  const T lambda = kappa - T(2.0 / 3.0) * mu;
  const T log_j = h[0] + h[1] + h[2], open = max(log_j, T(0)), pressed = min(log_j, T(0));
  const Sym3<T> stress = T(2) * mu * ((g - T(1)) * plus + log_v);
  // What damaged matter bears, over g: pressed along one axis it widens across until nothing pulls
  // there, and that must not drive it on.
  const T pull = max(lambda * (open + pressed / g) + T(2) * mu * h[0], T(0));
  const T young = T(9) * kappa * mu / (T(3) * kappa + mu);
  const T squares = up[0] * up[0] + up[1] * up[1] + up[2] * up[2];
  const T active = rankine * (T(0.5) * pull * pull / young) +
                   (T(1) - rankine) * (mu * squares + T(0.5) * lambda * open * open);
  return {active, add_diagonal(stress, lambda * (g * open + pressed))};
}
template <typename T>
GSF_HOST_DEVICE_COLD PhaseState<T> phase_state_spectral(const MaterialRow<T>& m, const Sym3<T>& e) {
  const T rankine = split_of(m) == kSplitRankine ? T(1) : T(0);
  return phase_state_spectral(m.mu, m.kappa, m.cohesion, rankine, e, PrincipalOfNumber<T>{});
}

// The product of two matrices that commute.
template <typename T>
GSF_HOST_DEVICE Sym3<T> commuting_product(const Sym3<T>& a, const Sym3<T>& b) {
  return {a.xx * b.xx + a.xy * b.xy + a.xz * b.xz, a.xy * b.xy + a.yy * b.yy + a.yz * b.yz,
          a.xz * b.xz + a.yz * b.yz + a.zz * b.zz, a.xx * b.xy + a.xy * b.yy + a.xz * b.yz,
          a.xx * b.xz + a.xy * b.yz + a.xz * b.zz, a.xy * b.xz + a.yy * b.yz + a.yz * b.zz};
}

// What phase_state_spectral gives where nothing is damaged, without principal strains, and the most
// that may drive (by kSplitRankine where rankine is 1, else 0). For numbers and for packs of them;
// |e|^2 up to kWholeStrain2. log(I + e) / 2 is the series of atanh(z), z = e / (2 + e).
inline constexpr double kWholeStrain2 = 0.09;
template <typename T>
GSF_HOST_DEVICE PhaseState<T> phase_state_whole(T mu, T kappa, T rankine, const Sym3<T>& e) {
  using std::sqrt;
  const Sym3<T> b = add_diagonal(e, T(2));
  const Sym3<T> adjugate = {b.yy * b.zz - b.yz * b.yz, b.xx * b.zz - b.xz * b.xz,
                            b.xx * b.yy - b.xy * b.xy, b.xz * b.yz - b.xy * b.zz,
                            b.xy * b.yz - b.xz * b.yy, b.xy * b.xz - b.xx * b.yz};
  const T inverse = T(1) / (b.xx * adjugate.xx + b.xy * adjugate.xy + b.xz * adjugate.xz);
  const Sym3<T> z = commuting_product(e, inverse * adjugate), z2 = square(z);
  constexpr int kTerms = 19;  // |z| is at most 0.18
  Sym3<T> sum = add_diagonal(Sym3<T>{}, T(1.0 / double(kTerms)));
  for (int n = kTerms - 2; n >= 1; n -= 2)
    sum = add_diagonal(commuting_product(z2, sum), T(1.0 / double(n)));
  const Sym3<T> h = commuting_product(z, sum);
  const T log_j = h.xx + h.yy + h.zz, squares = norm2(h);
  const T lambda = kappa - T(2.0 / 3.0) * mu, young = T(9) * kappa * mu / (T(3) * kappa + mu);
  const T away = max(squares - T(1.0 / 3.0) * log_j * log_j, T(0));
  const T largest = T(1.0 / 3.0) * log_j + T(0.816496580927727) * sqrt(away);
  const T pull = max(lambda * log_j + T(2) * mu * largest, T(0)), open = max(log_j, T(0));
  return {rankine * (T(0.5) * pull * pull / young) +
              (T(1) - rankine) * (mu * squares + T(0.5) * lambda * open * open),
          add_diagonal(T(2) * mu * h, lambda * log_j)};
}

template <typename T>
GSF_HOST_DEVICE T alpha_after(const MaterialRow<T>& m, T alpha, T active) {
  const T drive = m.strength > T(0) ? active / m.strength : T(0);
  return max(alpha, min(drive, T(kDriveMax)) - T(1));
}

// What phase_field does where neither bounds nor large strains come in, and the split is not
// spectral: stress and alpha. Otherwise false.
template <typename T>
GSF_HOST_DEVICE bool phase_field_small(const MaterialRow<T>& m, const Sym3<T>& e, Sym3<T>& stress,
                                       T& alpha) {
  const ElasticState<T> s = elastic_state(e, false);
  if (s.guarded || !(s.n < T(kBrokenShearMax)) || !(s.j2m1 > T(kSeriesPressed)) ||
      !(s.j2m1 < T(kBrokenVolumeMax)))
    return false;
  const T all = split_of(m) == kSplitNone ? T(1) : T(0);
  const PhaseState<T> now =
      phase_state(m.mu, m.kappa, m.cohesion, all, s.d, unit_det_shift_small(s.d), s.j2m1,
                  [](T x) { return volume_series(x); });
  stress = now.stress;
  alpha = alpha_after(m, alpha, now.active);
  return true;
}

template <typename T>
GSF_HOST_DEVICE_COLD LawResult<T> phase_field(const MaterialRow<T>& m, const Sym3<T>& e, T alpha,
                                              bool inverted) {
  using std::log1p;
  ElasticState<T> s = elastic_state(e, inverted);
  LawResult<T> out{s.e, s.e, alpha, false, s.guarded};
  if (m.cohesion >= T(kBrokenDamage)) {
    if (s.j2m1 > T(kBrokenVolumeMax)) {
      if (is_principal(m)) {
        // Or the other principal strains would be pressed as these are let go, and make energy.
        // Squared: d is no logarithm, and falls more slowly than one.
        const T kept = T(kBrokenLogMax) / log1p(s.j2m1);
        s.d = (kept * kept) * s.d;
        s.n *= kept * kept;
      }
      s.j2m1 = T(kBrokenVolumeMax);
      out.plastic = true;
    }
    if (s.n > T(kBrokenShearMax)) {
      s.d = (T(kBrokenShearMax) / s.n) * s.d;
      s.n = T(kBrokenShearMax);
      out.plastic = true;
    }
  }
  if (s.guarded || out.plastic) out.strain = strain_from_isochoric(s.d, log_volume(s));
  PhaseState<T> now;
  if (is_principal(m)) {
    now = phase_state_spectral(m, out.strain);
  } else {
    const T shift = s.n < T(0.5) ? unit_det_shift_small(s.d) : unit_det_shift(s.d);
    const auto volume = [](T x) {
      const bool small = x < T(kSeriesOpen) && x > T(kSeriesPressed);
      return small ? volume_series(x) : x - log1p(x);
    };
    const T all = split_of(m) == kSplitNone ? T(1) : T(0);
    now = phase_state(m.mu, m.kappa, m.cohesion, all, s.d, shift, s.j2m1, volume);
  }
  out.stress = now.stress;
  out.alpha = alpha_after(m, alpha, now.active);
  return out;
}

}  // namespace gsf
