// A Maxwell branch beside a neo-Hookean law (elastic, NACC): a spring and a dashpot that carry a
// share g of the stiffness. The law keeps the rest, so that what is loaded at once is as stiff as
// without, and what is held for long has (1 - g) of it: the standard linear solid, or one term of a
// Prony series (Simo and Hughes 1998, ch. 10; Reese and Govindjee 1998 for finite strain).
// Definition: ops/viscous.py; equations: docs/theory/viscous.md.
#pragma once

#include "core/material/rankine.h"

namespace gsf {

// Of a point: strain of the spring (0 to 5), g, 1 / tau [1/s], and the time T [s] of a yield. A
// negative 1 / tau: the spring is let go by what springs back faster than that.
inline constexpr int kViscousColumns = 9;

// exp(-dt / (2 tau)) to (dt / tau)^3 / 48, between 0 and 1 whatever the step.
template <typename T>
GSF_HOST_DEVICE T half_decay(T rate, T dt) {
  const T y = T(0.5) * rate * dt;
  return T(1) / (T(1) + y * (T(1) + T(0.5) * y));
}

// Strain of the spring after a step: it relaxes for half of it, goes along, relaxes for the rest.
template <typename T>
GSF_HOST_DEVICE Sym3<T> relaxed_strain(const Sym3<T>& spring, const Mat3<T>& increment, T half) {
  return half * update_strain(half * spring, increment);
}

// What is left of the spring in a step in which the law gives back what it stored at a rate above
// -rate: nothing from twice that on. So a landing returns 1 - g of its energy, however long it
// takes (Walton and Braun 1986: a spring that unloads along another line), and a slow load all of
// it.
//   tau   stress of the law [Pa], increment dt grad v, modulus kappa + 4 mu / 3 [Pa]
template <typename T>
GSF_HOST_DEVICE T kept_by_unloading(T rate, const Sym3<T>& tau, const Mat3<T>& increment, T modulus,
                                    T dt) {
  const Mat3<T>& a = increment;
  const T work = tau.xx * a(0, 0) + tau.yy * a(1, 1) + tau.zz * a(2, 2) +
                 tau.xy * (a(0, 1) + a(1, 0)) + tau.xz * (a(0, 2) + a(2, 0)) +
                 tau.yz * (a(1, 2) + a(2, 1));
  const T slow = max(T(0) - rate * dt, T(1e-30)) * (norm2(tau) + T(1e-6));
  return T(1) - clamp(T(0) - work * modulus / slow - T(1), T(0), T(1));
}

// (1 - g) tau of the law + g tau of the spring.
template <typename T>
GSF_HOST_DEVICE Sym3<T> shared_stress(const Sym3<T>& law, const Sym3<T>& spring, T share) {
  return (T(1) - share) * law + share * spring;
}

// A yield that takes time (Duvaut and Lions 1976; Simo and Hughes 1998, ch. 2.7): what the law says
// is where a state would be in the end, and a step goes dt / (T + dt) of the way there. Backward
// Euler, stable for any step; without a time all of the way.
template <typename T>
GSF_HOST_DEVICE T yielding_share(T time, T dt) {
  return time > T(0) ? dt / (time + dt) : T(1);
}

// The spring of brittle matter holds no more than the matter does: what of it lies beyond the yield
// surface goes back onto it as a state of the law would, and moves it no further. So a spring with
// the law's own strain keeps to it, one that never relaxes is not there, and what has broken cannot
// be held together by springs that relaxed while it was pressed. False: it is inside.
//   alpha   that of the law after its step
template <typename T>
GSF_HOST_DEVICE_COLD bool yield_spring(const NaccMaterial<T>& m, const NaccOptions<T>& o, T alpha,
                                       ElasticState<T>& spring) {
  const NaccOptions<T> still{o.k, o.epsilon, false};
  const NaccState<T> found = brittle_return(m, still, spring, alpha);
  spring.d = found.d;
  spring.j2m1 = found.j2m1;
  return found.plastic;
}

}  // namespace gsf
