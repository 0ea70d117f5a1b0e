// Non-associative Cam-Clay return mapping with the continuous dynamic centre, "algorithm D"
// (equations.md section 5) on strain e = b - I: no decomposition, one cubic root, no tip cases.
//
// Yield surface in (p, q), p the Kirchhoff pressure (compression positive), q = sqrt(3/2) |dev
// tau|:
//   q^2 (1 + 2 beta) + M^2 (p + beta p0)(p - p0) <= 0
//   p0 = kappa (1e-5 + sinh(xi max(-alpha, 0)))
// i.e. the unit disc u^2 + w^2 <= 1 in u = (p - p_c) / A, w = q / B.
// alpha is the log plastic volume ratio: negative intact, >= 0 fully softened.
#pragma once

#include "core/material/elastic.h"

namespace gsf {

inline constexpr double kYieldPressureFloor = 1e-5;  // p0 / kappa of fully softened material
inline constexpr double kYieldPressureCap = 0.495;   // p0 / kappa; keeps J >= 0.1 on the surface
inline constexpr double kCohesionMax = 1e3;          // 1 - |u| is a difference of O(1 / beta)
inline constexpr double kAlphaMin = -10.0;
inline constexpr double kAlphaMax = 0.5;      // debris in free flight must not soften forever
inline constexpr double kAlphaStepMax = 0.2;  // one bad step must not harden for good
inline constexpr double kFrictionMin = 1e-3;  // below: no shear strength, pressure clamped only

template <typename T>
struct NaccMaterial {
  T mu, kappa;     // shear and bulk modulus [Pa]
  T friction;      // M, slope of the critical state line
  T cohesion;      // beta
  T hardening;     // xi
  T shear_damage;  // eta: softening per plastic shear, 0 in the paper's equations
};

// How the map is computed; the defaults are the engine's, (k = 2, epsilon = 0, explicit) is the
// paper's, k = infinity with epsilon = 0 the fixed centre of CD-MPM.
template <typename T>
struct NaccOptions {
  T k;
  T epsilon;
  bool implicit_alpha;
};

template <typename T>
struct YieldSurface {
  T p0;      // compressive tip [Pa]
  T tip;     // tensile tip, -beta p0
  T center;  // p_c
  T a, b;    // half-width in p, half-height in q
};

template <typename T>
GSF_HOST_DEVICE YieldSurface<T> yield_surface(const NaccMaterial<T>& m, T alpha) {
  using std::sinh;
  using std::sqrt;
  const T beta = min(m.cohesion, T(kCohesionMax));
  const T x = min(m.hardening * max(-alpha, T(0)), T(5));  // sinh(5) is far beyond the cap
  const T relative = min(T(kYieldPressureFloor) + sinh(x), T(kYieldPressureCap));
  YieldSurface<T> y;
  y.p0 = m.kappa * relative;
  y.tip = -beta * y.p0;
  y.center = T(0.5) * (T(1) - beta) * y.p0;
  y.a = T(0.5) * (T(1) + beta) * y.p0;
  y.b = m.friction * y.a / sqrt(T(1) + T(2) * beta);
  return y;
}

// Trial pressure and deviatoric stress in units of the surface; clamped so that squares stay
// finite.
template <typename T>
GSF_HOST_DEVICE void normalized(const NaccMaterial<T>& m, const YieldSurface<T>& y, T p, T q, T& u,
                                T& w) {
  u = clamp((p - y.center) / y.a, T(-1e4), T(1e4));
  w = min(q / max(y.b, T(1e-8) * m.kappa), T(1e6));
}

template <typename T>
struct NaccReturn {
  T cross;  // pressure where the return line meets the surface: drives alpha
  T p;      // returned pressure
  T r;      // factor on the deviator, 0..1
};

// Projects (p, q) onto the surface along the line to the dynamic centre
// p_c* = p_c + (1 - eps) sgn(u) A min(|u|, 1)^(k + 1)  (GaussianFluent Eq. 6 at eps = 0).
template <typename T>
GSF_HOST_DEVICE NaccReturn<T> nacc_project(const NaccMaterial<T>& m, const NaccOptions<T>& o,
                                           const YieldSurface<T>& y, T p, T q) {
  using std::abs;
  using std::pow;
  using std::sqrt;
  T u, w;
  normalized(m, y, p, q, u, w);
  const T a = min(abs(u), T(1));
  const T power = o.k == T(2) ? a * a * a : pow(a, o.k + T(1));
  const T center = (u < T(0) ? T(-1) : T(1)) * (T(1) - o.epsilon) * power;
  const T gap = u - center;
  const T g = T(1) - center * center;
  // t < 1 outside the surface; center * gap >= 0, so the root is free of cancellation.
  const T t = min(T(1), g / max(center * gap + sqrt(gap * gap + w * w * g), T(1e-30)));
  NaccReturn<T> out;
  out.cross = y.center + y.a * (center + t * gap);
  // Relax only: same sign, never a larger |p|. With q not growing either, energy cannot increase.
  const T inside = clamp(p, y.tip, y.p0);
  const T relaxed = clamp(out.cross, min(inside, T(0)), max(inside, T(0)));
  // Without friction every deviator is beyond the surface: the pressure alone decides, also alpha.
  const bool frictionless = m.friction < T(kFrictionMin);
  if (frictionless) out.cross = inside;
  out.p = frictionless ? inside : relaxed;
  const T w_new =
      out.p == out.cross ? t * w : sqrt(max((y.p0 - out.p) * (out.p - y.tip), T(0))) / y.a;
  out.r = t < T(1) || out.p != p ? min(T(1), y.b * w_new / max(q, T(1e-30) * m.kappa)) : T(1);
  return out;
}

// What the search for alpha needs of a trial state.
template <typename T>
struct NaccTrial {
  T p, q;   // pressure, deviatoric stress [Pa]
  T n;      // |d|
  T log_j;  // ln J
};

// ln(J_trial / J_cross) plus shear damage eta (1 - r) q / (3 mu), with q / (3 mu) = |d| / sqrt(6).
template <typename T>
GSF_HOST_DEVICE T alpha_step(const NaccMaterial<T>& m, const NaccTrial<T>& trial,
                             const NaccReturn<T>& ret) {
  using std::log1p;
  const T volume = trial.log_j - T(0.5) * log1p(T(-2) * ret.cross / m.kappa);
  const T shear = m.shear_damage * (T(1) - ret.r) * trial.n * T(0.4082482904638631);
  return clamp(volume + shear, T(-kAlphaStepMax), T(kAlphaStepMax));
}

// Residual of the implicit update: x - alpha_n - step(surface at x).
template <typename T>
GSF_HOST_DEVICE T alpha_residual(const NaccMaterial<T>& m, const NaccOptions<T>& o,
                                 const NaccTrial<T>& trial, T alpha, T x) {
  const NaccReturn<T> ret = nacc_project(m, o, yield_surface(m, x), trial.p, trial.q);
  return (x - alpha) - alpha_step(m, trial, ret);
}

// Solves x = alpha + step(x) on the side of the first step. The step is continuous and bounded by
// kAlphaStepMax, so that a root always lies between alpha and alpha +- kAlphaStepMax.
//
// 1. Walk away from alpha by secant steps (at least once, at most four times the last) until the
//    residual changes sign: hardening is bracketed at once, softening approaches its root from the
//    near side. Softening faster than elastic unloading (cohesion * hardening > 1 at the tensile
//    tip) has no near root; the walk then ends where the strength is gone, as in the continuous
//    equations.
// 2. Close the bracket by Anderson-Bjorck secants.
//
// A step that overshoots the surface by more than its own size can have several roots; which one is
// found is then a property of this algorithm, which the reference repeats.
template <typename T>
GSF_HOST_DEVICE T solve_alpha(const NaccMaterial<T>& m, const NaccOptions<T>& o,
                              const NaccTrial<T>& trial, T alpha, T first_step) {
  using std::abs;
  const T eps = sizeof(T) == 4 ? T(1.2e-7) : T(2.2e-16);
  // The step is a difference of logarithms of this size: below it there is only rounding to solve.
  const T tolerance = T(4) * eps * (abs(alpha) + abs(first_step) + abs(trial.log_j));
  if (!(abs(first_step) > tolerance)) return alpha + first_step;
  const T far = alpha + (first_step > T(0) ? T(kAlphaStepMax) : T(-kAlphaStepMax));
  T x0 = alpha, f0 = -first_step;
  T x1 = alpha + first_step;
  T f1 = alpha_residual(m, o, trial, alpha, x1);
  for (int i = 0; i < 40 && f0 * f1 > T(0) && abs(f1) > tolerance && x1 != far; ++i) {
    const T last = x1 - x0;
    const T ratio = f0 - f1 != T(0) ? f1 / (f0 - f1) : T(4);  // secant step in units of the last
    const T step = last * (ratio > T(0) ? clamp(ratio, T(1), T(4)) : T(4));
    x0 = x1;
    f0 = f1;
    x1 = abs(x1 + step - alpha) < T(kAlphaStepMax) ? x1 + step : far;
    f1 = alpha_residual(m, o, trial, alpha, x1);
  }
  T before = abs(f1);
  for (int i = 0; i < 60; ++i) {
    if (abs(f1) <= tolerance || !(abs(x1 - x0) > tolerance)) break;
    T x = x1 - f1 * (x1 - x0) / (f1 - f0);
    const T lo = min(x0, x1), hi = max(x0, x1);
    // Bisect when eight secants gained little, and only then: from the root that float32 has
    // reached by now, float64 would be thrown to another one.
    const bool check = (i & 7) == 7;
    if (!(x > lo && x < hi) || (check && abs(f1) > T(0.1) * before)) x = T(0.5) * (lo + hi);
    if (check) before = abs(f1);
    const T f = alpha_residual(m, o, trial, alpha, x);
    if (f * f1 < T(0)) {
      x0 = x1;
      f0 = f1;
    } else {
      const T scale = T(1) - f / f1;
      f0 *= scale > T(0) ? scale : T(0.5);
    }
    x1 = x;
    f1 = f;
  }
  return x1;
}

// Part of a trial state that a law hands back: deviator, volume, alpha.
template <typename T>
struct NaccState {
  Sym3<T> d;
  T j2m1, alpha;
  bool plastic;
};

// The way back to the surface, taken by yielding particles only (kept out of line on the device).
template <typename T>
GSF_HOST_DEVICE_COLD NaccState<T> nacc_plastic(const NaccMaterial<T>& m, const NaccOptions<T>& o,
                                               const ElasticState<T>& s, T alpha) {
  const T p = T(-0.5) * m.kappa * s.j2m1;
  const T q = T(1.224744871391589) * m.mu * s.n;  // sqrt(3/2) mu |d|
  NaccState<T> out{s.d, s.j2m1, alpha, false};
  const YieldSurface<T> y = yield_surface(m, alpha);
  T u, w;
  normalized(m, y, p, q, u, w);
  const T slack = sizeof(T) == 4 ? T(1e-6) : T(2e-15);  // scale free: a returned state is inside
  if (!(u * u + w * w > T(1) + slack)) return out;
  out.plastic = true;
  const NaccTrial<T> trial{p, q, s.n, log_volume(s)};
  NaccReturn<T> ret = nacc_project(m, o, y, p, q);
  const T step = alpha_step(m, trial, ret);
  out.alpha = clamp(alpha + step, T(kAlphaMin), T(kAlphaMax));
  // Without strength the surface is the same whatever alpha: solve_alpha would find this step too.
  if (o.implicit_alpha && !(alpha >= T(0) && out.alpha >= T(0))) {
    out.alpha = clamp(solve_alpha(m, o, trial, alpha, step), T(kAlphaMin), T(kAlphaMax));
    ret = nacc_project(m, o, yield_surface(m, out.alpha), p, q);
  }
  out.d = ret.r * s.d;
  out.j2m1 = T(-2) * ret.p / m.kappa;
  return out;
}

// True only for states inside the surface, by a test without sinh, roots or divisions: the
// surfaces are nested in p0, and x + x^3/6 + x^5/120 <= sinh x gives one inside the real one. What
// fails it by little is decided by the exact test in nacc_plastic, so that results do not depend on
// it.
template <typename T>
GSF_HOST_DEVICE bool nacc_clearly_elastic(const NaccMaterial<T>& m, const ElasticState<T>& s,
                                          T alpha) {
  const T beta = min(m.cohesion, T(kCohesionMax));
  const T x = min(m.hardening * max(-alpha, T(0)), T(5));
  const T x2 = x * x;
  const T relative =
      T(kYieldPressureFloor) + x * (T(1) + x2 * (T(1.0 / 6.0) + x2 * T(1.0 / 120.0)));
  const T p0 = m.kappa * min(relative, T(kYieldPressureCap));
  const T p = T(-0.5) * m.kappa * s.j2m1;
  const T q2 = T(1.5) * m.mu * m.mu * s.n * s.n;
  const T room = m.friction * m.friction * (p + beta * p0) * (p0 - p);
  return p < p0 && p > -beta * p0 && q2 * (T(1) + T(2) * beta) < T(0.9999) * room;
}

template <typename T>
GSF_HOST_DEVICE NaccState<T> nacc_return(const NaccMaterial<T>& m, const NaccOptions<T>& o,
                                         const ElasticState<T>& s, T alpha) {
  alpha = clamp(alpha, T(kAlphaMin), T(kAlphaMax));
  if (nacc_clearly_elastic(m, s, alpha)) return {s.d, s.j2m1, alpha, false};
  // A copy, so that the state of an elastic particle need not be in memory.
  const ElasticState<T> yielding = s;
  const NaccMaterial<T> of = m;
  return nacc_plastic(of, o, yielding, alpha);
}

}  // namespace gsf
