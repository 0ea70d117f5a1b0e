// Neo-Hookean elasticity of Borden on strain e = b - I (equations.md section 2.1), and the trial
// state every law starts from, with its guards.
//
//   Psi = mu/2 (J^(-2/3) tr b - 3) + kappa/2 ((J^2 - 1)/2 - ln J)          energy per initial
//   volume tau = mu d + kappa/2 (J^2 - 1) I,   d = J^(-2/3) dev b                  Kirchhoff stress
#pragma once

#include "core/sym3.h"

namespace gsf {

// Bounds of a state the laws accept. Outside, the state is pulled back and counted: the volume
// ratio to [kJMin, kJMax], the isochoric deviator to |d| <= kDeviatorMax (a stretch of about 10).
// Each pull lowers the stored energy (volumetric and deviatoric parts separately).
inline constexpr double kJMin = 0.05;
inline constexpr double kJMax = 20.0;
inline constexpr double kDeviatorMax = 100.0;
// Larger strains are first blended toward rest, b <- (1 - f) I + f b, so that cubes do not
// overflow.
inline constexpr double kStrainMax = 1e4;

template <typename T>
struct ElasticState {
  Sym3<T> e;      // strain b - I
  Sym3<T> d;      // isochoric deviator J^(-2/3) dev b
  T j2m1;         // J^2 - 1
  T isochoric;    // J^(-2/3) of the volume that the strain came with
  T n;            // |d|
  bool guarded;   // e is out of bounds: d, j2m1 are the pulled-back ones, e is not
  bool inverted;  // the step turned the material inside out: det(I + A) <= 0
};

// ln J of a state; only what yields or was pulled back needs it.
template <typename T>
GSF_HOST_DEVICE T log_volume(const ElasticState<T>& s) {
  using std::log1p;
  return T(0.5) * log1p(s.j2m1);
}

// (1 + x)^(-1/3) - 1 for x > -1, accurate relative to x. Near 0 by Newton's iteration, which costs
// a fifth of the logarithm and the exponential.
template <typename T>
GSF_HOST_DEVICE T inverse_cube_root_minus_one(T x) {
  using std::expm1;
  using std::log1p;
  if (!(x > T(-0.1) && x < T(0.1))) return expm1(T(-1.0 / 3.0) * log1p(x));
  // Each step turns the error r into 2 r^2: 1e-5, 4e-10, 3e-19.
  T z = x * (T(-1.0 / 3.0) + x * (T(2.0 / 9.0) - x * T(14.0 / 81.0)));
  for (int i = 0; i < (sizeof(T) == 4 ? 1 : 2); ++i) {
    // y (1 - (1 + x) y^3) / 3, with y^3 - 1 = z (3 + z (3 + z))
    const T cubed = z * (T(3) + z * (T(3) + z));
    z -= T(1.0 / 3.0) * (T(1) + z) * (cubed + x * (T(1) + cubed));
  }
  return z;
}

template <typename T>
GSF_HOST_DEVICE T inverse_cube_root(T x) {
  return T(1) + inverse_cube_root_minus_one(x);
}

// Invariants of strain e, guarded. `inverted` states count as fully compressed (J = kJMin): b has
// lost the sign of J, so a reflected state would otherwise look unstrained.
template <typename T>
GSF_HOST_DEVICE ElasticState<T> elastic_state(Sym3<T> e, bool inverted) {
  using std::sqrt;
  const T j2_lo = T(kJMin * kJMin - 1.0), j2_hi = T(kJMax * kJMax - 1.0);
  ElasticState<T> s;
  s.inverted = inverted;
  const T largest = max_abs(e);
  s.guarded = inverted || largest > T(kStrainMax);
  if (largest > T(kStrainMax)) e = (T(kStrainMax) / largest) * e;
  s.e = e;

  const T raw = inverted ? j2_lo : det_minus_one(e);
  // `!(raw >= lo)` also catches what rounding made of the determinant of a nearly singular b.
  const T from_below = raw >= j2_lo ? raw : j2_lo;
  s.j2m1 = min(from_below, j2_hi);
  s.guarded = s.guarded || !(raw >= j2_lo) || raw > j2_hi;

  // The deviator is made isochoric with the volume it came with; only then is the volume bounded.
  s.isochoric = inverse_cube_root(from_below);
  s.d = s.isochoric * deviator(e);
  s.n = sqrt(norm2(s.d));
  if (s.n > T(kDeviatorMax)) {
    s.d = (T(kDeviatorMax) / s.n) * s.d;
    s.n = T(kDeviatorMax);
    s.guarded = true;
  }
  return s;
}

// Strain of the state with isochoric deviator d and volume ratio exp(log_j):
// b = J^(2/3) (m I + d), m from det(m I + d) = 1.
template <typename T>
GSF_HOST_DEVICE Sym3<T> strain_from_isochoric(const Sym3<T>& d, T log_j) {
  using std::expm1;
  const T y = unit_det_shift(d);
  const T s = expm1(T(2.0 / 3.0) * log_j);  // J^(2/3) - 1
  return add_diagonal((T(1) + s) * d, y + s * (T(1) + y));
}

// Kirchhoff stress [Pa].
template <typename T>
GSF_HOST_DEVICE Sym3<T> kirchhoff_stress(T mu, T kappa, const Sym3<T>& d, T j2m1) {
  return add_diagonal(mu * d, T(0.5) * kappa * j2m1);
}

// Stored energy per initial volume [J/m^3]; tr(m I + d) - 3 = 3 (m - 1) avoids the cancellation of
// J^(-2/3) tr b - 3, and the volumetric part is summed as a series near J = 1.
template <typename T>
GSF_HOST_DEVICE T stored_energy(T mu, T kappa, const Sym3<T>& d, T j2m1, T log_j) {
  using std::abs;
  const T x = j2m1;
  const T series = x * x * (T(0.5) - x * (T(1.0 / 3.0) - x * (T(0.25) - x * T(0.2))));
  const T volumetric = abs(x) < T(1e-3) ? series : x - T(2) * log_j;
  return T(1.5) * mu * unit_det_shift(d) + T(0.25) * kappa * volumetric;
}

template <typename T>
GSF_HOST_DEVICE T elastic_energy(T mu, T kappa, const ElasticState<T>& s) {
  return stored_energy(mu, kappa, s.d, s.j2m1, log_volume(s));
}

// The same of a strain as it is, without guards: nan where det b is not positive.
template <typename T>
GSF_HOST_DEVICE T unguarded_energy(T mu, T kappa, const Sym3<T>& e) {
  using std::exp;
  using std::log1p;
  const T x = det_minus_one(e);
  const T log_j = T(0.5) * log1p(x);
  return stored_energy(mu, kappa, exp(T(-2.0 / 3.0) * log_j) * deviator(e), x, log_j);
}

}  // namespace gsf
