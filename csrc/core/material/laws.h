// The laws beside neo-Hookean and NACC, on strain e = b - I: fixed corotated elasticity, von Mises
// metal and Drucker-Prager sand on the Hencky strain ln V, the weakly compressible fluid
// (equations.md section 9). The rigid law is stress-free and needs no code here.
#pragma once

#include "core/material/elastic.h"
#include "core/spectral.h"

namespace gsf {

enum Law : int {
  kElastic = 0,  // neo-Hookean
  kNacc = 1,
  kDruckerPrager = 2,
  kVonMises = 3,
  kFluid = 4,
  kRigid = 5,
  kCorotated = 6,
  kPhaseField = 9,
  kLawCount = 10,
};

// Numbers 7 and 8 are rubber, compiled apart (more_laws.h).
GSF_HOST_DEVICE bool is_law(int law) { return law >= 0 && law < kLawCount && law != 7 && law != 8; }

// A row of `params`; what the columns hold depends on the law.
template <typename T>
struct MaterialRow {
  T mu;         // shear modulus [Pa]
  T kappa;      // bulk modulus [Pa]
  T strength;   // nacc: M | drucker_prager: alpha_DP | von_mises: sigma_y [Pa] | fluid: eta [Pa s]
                // phase_field: threshold of psi+ [Pa]
  T cohesion;   // nacc: beta | drucker_prager: tensile pressure [Pa] | phase_field: damage d
  T hardening;  // nacc: xi | von_mises: hardening modulus [Pa] | phase_field: length [m]
  T damage;     // nacc: eta, shear damage; below zero: -c of Rankine's surface (rankine.h)
                // phase_field: split and model (phase_field.h)
  T density;    // [kg/m^3]
  T exponent;   // fluid: gamma, 7 when 0 | nacc, phase_field: loss, by restitution (loss.h)
};

inline constexpr double kFluidExponent = 7.0;
inline constexpr double kFluidJMin = 0.6;
// Beyond this a liquid has parted: the excess is forgotten, so that spray is not denser than the
// pool when it comes back.
inline constexpr double kFluidJMax = 1.2;
// The same as ln J and as the strain J^(2/3) - 1.
inline constexpr double kFluidLogJMin = -0.5108256237659907;
inline constexpr double kFluidStrainMin = -0.2886213391019874;
inline constexpr double kFluidStrainMax = 0.12924323465723409;
constexpr bool fluid_strain_is(double strain, double j) {
  const double b = 1.0 + strain, off = b * b * b - j * j;
  return off < 1e-14 && off > -1e-14;
}
static_assert(fluid_strain_is(kFluidStrainMin, kFluidJMin));
static_assert(fluid_strain_is(kFluidStrainMax, kFluidJMax));
inline constexpr double kFluidStepMin = 0.8, kFluidStepMax = 1.25;  // growth of J per step
inline constexpr double kGapMax = 0.5;  // log volume that parted sand remembers

// What a law makes of a trial state.
template <typename T>
struct LawResult {
  Sym3<T> strain;  // b' - I
  Sym3<T> stress;  // Kirchhoff [Pa]
  T alpha;
  bool plastic, guarded;
};

// --- Hencky elasticity: Psi = mu |dev ln V|^2 + kappa/2 (ln J)^2 ---

template <typename T>
struct HenckyState {
  Sym3<T> e;    // strain, pulled back when guarded
  Sym3<T> dev;  // deviator of ln V
  T n;          // its norm
  T log_j;
  bool guarded;
};

template <typename T>
GSF_HOST_DEVICE HenckyState<T> hencky_state(const Sym3<T>& e, bool inverted) {
  using std::sqrt;
  HenckyState<T> h;
  h.e = e;
  h.guarded = false;
  if (!inverted && norm2(e) < T(kSeriesStrain * kSeriesStrain)) {
    const Logarithm<T> l = log_small(e);
    h.dev = l.deviator;
    h.log_j = l.log_j;
  } else {
    const ElasticState<T> s = elastic_state(e, inverted);
    h.guarded = s.guarded;
    if (s.guarded) h.e = strain_from_isochoric(s.d, log_volume(s));
    h.dev = log_deviator_large(h.e);
    h.log_j = log_volume(s);
  }
  h.n = sqrt(norm2(h.dev));
  return h;
}

// Strain of the state with ln V = dev + (log_j / 3) I.
template <typename T>
GSF_HOST_DEVICE Sym3<T> strain_from_hencky(const Sym3<T>& dev, T log_j) {
  using std::expm1;
  const T s = expm1(T(2.0 / 3.0) * log_j);
  return add_diagonal((T(1) + s) * exp_minus_identity(T(2) * dev), s);
}

template <typename T>
GSF_HOST_DEVICE Sym3<T> hencky_stress(const MaterialRow<T>& m, const Sym3<T>& dev, T log_j) {
  return add_diagonal(T(2) * m.mu * dev, m.kappa * log_j);
}

// --- von Mises: |dev tau| <= sqrt(2/3) (sigma_y + H alpha), radial return ---
// alpha is the accumulated (equivalent) plastic strain. Simo and Hughes, box 3.1, on ln V.

template <typename T>
GSF_HOST_DEVICE LawResult<T> von_mises(const MaterialRow<T>& m, const Sym3<T>& e, T alpha,
                                       bool inverted) {
  const T root = T(0.816496580927726);  // sqrt(2/3)
  const HenckyState<T> h = hencky_state(e, inverted);
  const T before = max(alpha, T(0));
  const T limit = root * (m.strength + m.hardening * before);
  // Scale free: a returned state is inside, also when its volume is all there is of its strain.
  const T slack = sizeof(T) == 4 ? T(4e-6) : T(1e-14);
  const T trial = T(2) * m.mu * h.n;
  if (!(trial > limit + slack * (limit + T(0.25) * m.mu * max(h.log_j, -h.log_j))))
    return {h.e, hencky_stress(m, h.dev, h.log_j), before, false, h.guarded};
  const T slip = (trial - limit) / (T(2) * m.mu + T(2.0 / 3.0) * m.hardening);
  const Sym3<T> dev = max(T(1) - slip / h.n, T(0)) * h.dev;
  return {strain_from_hencky(dev, h.log_j), hencky_stress(m, dev, h.log_j), before + root * slip,
          true, h.guarded};
}

// --- Drucker-Prager: |dev tau| <= 3 alpha_DP (p + c), no stress beyond the apex p = -c ---
// Klar et al. 2016. alpha is the volume correction of Tampubolon et al. 2017: the log volume that
// opened while the grains had parted, which must close again before they press on each other.

template <typename T>
GSF_HOST_DEVICE LawResult<T> drucker_prager(const MaterialRow<T>& m, const Sym3<T>& e, T alpha,
                                            bool inverted) {
  const HenckyState<T> h = hencky_state(e, inverted);
  const T gap = clamp(alpha, T(0), T(kGapMax));
  const T apex = m.cohesion / m.kappa;
  // Only compression closes the gap: the elastic volume moves toward rest, never past it.
  const T closing = clamp(-h.log_j, T(0), gap);
  T log_j = h.log_j + closing;
  const T opened = max(log_j - apex, T(0));
  log_j = min(log_j, apex);
  const T limit = T(1.5) * m.strength * m.kappa / m.mu * (apex - log_j);
  const T slack = sizeof(T) == 4 ? T(4e-6) : T(1e-14);
  const bool slides = h.n > limit + slack * (limit + max(log_j, -log_j));
  if (!slides && closing == T(0) && opened == T(0))
    return {h.e, hencky_stress(m, h.dev, h.log_j), gap, false, h.guarded};
  const Sym3<T> dev = (slides ? limit / h.n : T(1)) * h.dev;
  return {strain_from_hencky(dev, log_j), hencky_stress(m, dev, log_j),
          min(gap - closing + opened, T(kGapMax)), true, h.guarded};
}

// --- fixed corotated: tau = 2 mu (F - R) F^T + lambda J (J - 1) I = 2 mu (b - V) + ... ---

template <typename T>
GSF_HOST_DEVICE LawResult<T> corotated(const MaterialRow<T>& m, const Sym3<T>& e, T alpha,
                                       bool inverted) {
  using std::sqrt;
  LawResult<T> out{e, e, alpha, false, false};
  T j2m1;
  if (!inverted && norm2(e) < T(kSeriesStrain * kSeriesStrain)) {
    j2m1 = det_minus_one(e);
  } else {
    const ElasticState<T> s = elastic_state(e, inverted);
    out.guarded = s.guarded;
    if (s.guarded) out.strain = strain_from_isochoric(s.d, log_volume(s));
    j2m1 = s.j2m1;
  }
  const T j = sqrt(T(1) + j2m1);
  const T lambda = m.kappa - T(2.0 / 3.0) * m.mu;
  const Sym3<T> v = sqrt_minus_identity(out.strain);
  out.stress =
      add_diagonal(T(2) * m.mu * (out.strain + T(-1) * v), lambda * j * (j2m1 / (T(1) + j)));
  return out;
}

// J eta (A + A^T - 2/3 tr A I) of a velocity gradient A, or of an increment with J eta / dt.
template <typename T>
GSF_HOST_DEVICE Sym3<T> newtonian_stress(T scale, const Mat3<T>& a) {
  const T mean = T(2.0 / 3.0) * (a.m[0] + a.m[4] + a.m[8]);
  const Sym3<T> rate = {T(2) * a.m[0] - mean, T(2) * a.m[4] - mean, T(2) * a.m[8] - mean,
                        a.m[1] + a.m[3],      a.m[2] + a.m[6],      a.m[5] + a.m[7]};
  return scale * rate;
}

// --- weakly compressible fluid: p = K/gamma (J^-gamma - 1), no tension, Newtonian viscosity ---
// The strain stays isotropic, e = (J^(2/3) - 1) I. J follows det(I + A), as the positions do that
// are moved by the same velocities; 1 + tr A would lose the difference at every step, and the pool
// would grow or shrink. What is added to e vanishes with A, so that a resting fluid keeps its bits.

template <typename T>
GSF_HOST_DEVICE LawResult<T> fluid(const MaterialRow<T>& m, const Sym3<T>& strain, T alpha,
                                   const Mat3<T>& increment, T dt) {
  using std::expm1;
  using std::log1p;
  using std::sqrt;
  LawResult<T> out{strain, strain, alpha, false, false};
  T x = strain.xx;
  const bool isotropic = strain.yy == x && strain.zz == x && strain.xy == T(0) &&
                         strain.xz == T(0) && strain.yz == T(0);
  if (!isotropic) {
    const T j2m1 = det_minus_one(strain);
    x = j2m1 > T(-0.9999) ? expm1(log1p(j2m1) * T(1.0 / 3.0)) : T(-1);
  }
  const T growth = det_minus_one(increment);
  const T step = clamp(growth, T(kFluidStepMin - 1.0), T(kFluidStepMax - 1.0));
  // (1 + step)^(2/3) - 1
  const T stretch = step + (T(1) + step) * inverse_cube_root_minus_one(step);
  x += (T(1) + x) * stretch;
  const T lo = T(kFluidStrainMin), hi = T(kFluidStrainMax);
  out.guarded = step != growth || x < lo;
  out.plastic = x > hi;
  x = clamp(x, lo, hi);
  out.strain = {x, x, x, T(0), T(0), T(0)};

  const T j = (T(1) + x) * sqrt(T(1) + x);
  T pressure = T(0);
  if (x < T(0)) {
    const T gamma = m.exponent > T(0) ? m.exponent : T(kFluidExponent);
    pressure = m.kappa / gamma * expm1(T(-1.5) * gamma * log1p(x));
  }
  out.stress = {-j * pressure, -j * pressure, -j * pressure, T(0), T(0), T(0)};
  if (m.strength > T(0) && dt > T(0))
    out.stress = out.stress + newtonian_stress(j * m.strength / dt, increment);
  return out;
}

}  // namespace gsf
