// Speed of the fastest small wave in the present state: what bounds an explicit time step.
//
// With principal Kirchhoff stresses tau_i and log stretches h_i, a longitudinal wave along axis i
// travels at rho_0 c^2 = d tau_i / d h_i - tau_i, a shear wave at (tau_i - tau_j) / (b_i - b_j)
// b_i. The functions below bound the largest of these from above by invariants (no eigenvalues):
// exact at rest, a few percent high at moderate strain.
#pragma once

#include "core/material/laws.h"

namespace gsf {

// Square of the wave speed [m^2/s^2]; 0 for a rigid body and for a state that is not finite (which
// the return map resets).
template <typename T>
GSF_HOST_DEVICE T wave_speed_squared(int law, const MaterialRow<T>& m, const Sym3<T>& strain) {
  using std::exp;
  using std::log1p;
  using std::sqrt;
  if (law == kRigid || !finite(strain)) return T(0);
  const T j2_lo = T(kJMin * kJMin - 1.0), j2_hi = T(kJMax * kJMax - 1.0);
  const T raw = det_minus_one(strain);
  const T j2m1 = raw >= j2_lo ? min(raw, j2_hi) : j2_lo;
  if (law == kFluid) {
    const T gamma = m.exponent > T(0) ? m.exponent : T(kFluidExponent);
    const T log_j = clamp(T(0.5) * log1p(j2m1), T(kFluidLogJMin), T(0));
    return m.kappa * exp((T(1) - gamma) * log_j) / m.density;
  }
  const T third = trace(strain) * T(1.0 / 3.0);
  const T size = min(sqrt(norm2(deviator(strain))), T(kStrainMax));
  if (law == kCorotated) {
    // 2 mu b_i + lambda J^2; the largest eigenvalue of a deviator is at most sqrt(2/3) of its norm.
    const T largest = max(T(1) + third + T(0.816496580927726) * size, T(0));
    return (T(2) * m.mu * largest + (m.kappa - T(2.0 / 3.0) * m.mu) * (T(1) + j2m1)) / m.density;
  }
  const T isochoric = inverse_cube_root(j2m1);
  const T n = min(isochoric * size, T(kDeviatorMax));
  if (law == kDruckerPrager || law == kVonMises) {
    // kappa + 4/3 mu - tau_i, and |dev ln V| <= 0.6 n.
    const T log_j = T(0.5) * log1p(j2m1);
    return (m.kappa * max(T(1) - log_j, T(0)) + m.mu * (T(4.0 / 3.0) + n)) / m.density;
  }
  // mu (5/3 mean - 1/3 b_i) + kappa/2 (J^2 + 1) along i, mu b_i across, of the isochoric b.
  const T mean = clamp(isochoric * (T(1) + third), T(1), T(kDeviatorMax));
  const T along =
      m.mu * (T(4.0 / 3.0) * mean + T(0.272165526975909) * n) + T(0.5) * m.kappa * (T(2) + j2m1);
  const T across = m.mu * (mean + T(0.816496580927726) * n);
  return max(along, across) / m.density;
}

}  // namespace gsf
