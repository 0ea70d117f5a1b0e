// Rankine's tension cut-off, softened by what has opened, with a bound on shear beside it: the other
// yield surface of brittle matter (docs/theory/return-mapping.md). Feenstra and de Borst 1996 for
// the corners of the cut-off, Bazant and Oh 1983 for the energy per volume.
//
//   tau_i <= f(alpha),   f = beta kappa sinh(xi max(-alpha, 0))       principal Kirchhoff stresses
//   q <= max(c f, M p)                                                c = -eta of the row
//
// Associated flow opens along the principal directions that are pulled, and alpha grows by what
// has opened, so that whatever the path the loss of all strength takes the integral of f over alpha
// per initial volume, no more and no less. Shear flows at constant volume and counts as no damage.
// Past zero alpha is the log volume that opened where broken matter lost all stress, and has to close
// before it presses again (Tampubolon et al. 2017).
#pragma once

#include "core/material/nacc.h"
#include "core/spectral.h"

namespace gsf {

inline constexpr double kSteepestOpening = 0.98;   // -df/dalpha over kappa that a round counts on
// A state that was returned is inside, whatever rounding and the last round left.
template <typename T>
inline constexpr T kRankineSlack = sizeof(T) == 4 ? T(4e-6) : T(1e-12);
inline constexpr double kLargestTension = 0.8165;  // largest eigenvalue of d over |d|: sqrt(2/3)

template <typename T>
struct TensileStrength {
  T value, slope;  // f and -df/dalpha [Pa]
};

template <typename T>
GSF_HOST_DEVICE TensileStrength<T> tensile_strength(const NaccMaterial<T>& m, T alpha) {
  using std::cosh;
  using std::sinh;
  const T size = m.cohesion * m.kappa;
  const T x = min(m.hardening * max(-alpha, T(0)), T(5));
  if (!(alpha < T(0))) return {T(0), T(0)};
  return {size * sinh(x), size * m.hardening * cosh(x)};
}

// True only for states inside, by a test without roots or functions: the largest principal stress
// is at most mu sqrt(2/3) |d| more than the mean, and x + x^3/6 + x^5/120 <= sinh x.
template <typename T>
GSF_HOST_DEVICE bool rankine_clearly_elastic(const NaccMaterial<T>& m, const ElasticState<T>& s,
                                             T alpha) {
  const T x = min(m.hardening * max(-alpha, T(0)), T(5)), x2 = x * x;
  const T f = m.cohesion * m.kappa * x * (T(1) + x2 * (T(1.0 / 6.0) + x2 * T(1.0 / 120.0)));
  const T mean = T(0.5) * m.kappa * s.j2m1, shear = m.mu * s.n;
  const T most = max(T(0) - m.shear_damage * f, T(0) - m.friction * mean);
  return mean + T(kLargestTension) * shear < T(0.9999) * f &&
         T(1.224744871391589) * shear < T(0.9999) * most && !(alpha > T(0) && mean < T(0));
}

// What a trial state opens: principal log strains taken away, and their sum.
template <typename T>
struct Opening {
  T by[3], sum;
};

// Box of the principal stresses below f = f0 - slope S, of a linear law with Lame's constants:
// t are the trial stresses, largest first. Each face, edge or corner in turn.
template <typename T>
GSF_HOST_DEVICE Opening<T> cut_off(const T* t, T lambda, T mu, T f0, T slope) {
  Opening<T> o{{T(0), T(0), T(0)}, T(0)};
  if (!(t[0] > f0)) return o;
  T s = (t[0] - f0) / (lambda + T(2) * mu - slope);
  if (!(t[1] - lambda * s > f0 - slope * s)) {
    o.by[0] = o.sum = s;
    return o;
  }
  s = (t[0] + t[1] - T(2) * f0) / (T(2) * (lambda + mu - slope));
  if (!(t[2] - lambda * s > f0 - slope * s)) {
    const T apart = min((t[0] - t[1]) / (T(2) * mu), s);
    o.by[0] = T(0.5) * (s + apart);
    o.by[1] = T(0.5) * (s - apart);
    o.sum = s;
    return o;
  }
  const T third = T(1.0 / 3.0), mean = third * (t[0] + t[1] + t[2]);
  s = (mean - f0) / (lambda + T(2.0 / 3.0) * mu - slope);
  for (int i = 0; i < 3; ++i) o.by[i] = third * s + (t[i] - mean) / (T(2) * mu);
  o.sum = s;
  return o;
}

// Principal Kirchhoff stresses of principal log strains; `iso` gets b_i / J^(2/3) less their mean.
template <typename T>
GSF_HOST_DEVICE T principal_stresses(T mu, T kappa, const T* log_v, T* stress, T* iso) {
  using std::expm1;
  const T log_j = log_v[0] + log_v[1] + log_v[2];
  T sum = T(0);
  for (int i = 0; i < 3; ++i) {
    iso[i] = expm1(T(2) * (log_v[i] - T(1.0 / 3.0) * log_j));
    sum += iso[i];
  }
  const T j2m1 = expm1(T(2) * log_j);
  for (int i = 0; i < 3; ++i) {
    iso[i] -= T(1.0 / 3.0) * sum;
    stress[i] = mu * iso[i] + T(0.5) * kappa * j2m1;
  }
  return j2m1;
}

// The way back onto the cut-off. A linear law through the last state, stress and slope of its
// strength, is solved in closed form, until it is the law: exact where strains are small, a digit
// or two per round otherwise. softens: alpha moves with the state; else f is that of alpha.
template <typename T>
GSF_HOST_DEVICE bool open_cracks(const NaccMaterial<T>& m, bool softens, NaccState<T>& s) {
  using std::abs;
  using std::log1p;
  const T slack = kRankineSlack<T>;
  const Vec3<T> found = eigenvalues_jacobi(s.d);
  const T y[3] = {found.x, found.y, found.z};
  const T mean = T(0.5) * m.kappa * s.j2m1;
  const TensileStrength<T> before = tensile_strength(m, s.alpha);
  if (!(m.mu * y[0] + mean >
        before.value + slack * (before.value + m.mu * abs(y[0]) + abs(mean))))
    return false;
  const T shift = unit_det_shift(s.d), third = T(1.0 / 6.0) * log1p(s.j2m1);
  T trial[3], log_v[3], stress[3], iso[3];
  for (int i = 0; i < 3; ++i) {
    trial[i] = T(0.5) * log1p(max(shift + y[i], T(kEigenvalueMin - 1.0))) + third;
    log_v[i] = trial[i];
  }
  const T lambda = m.kappa - T(2.0 / 3.0) * m.mu;
  const T tolerance = (sizeof(T) == 4 ? T(2e-7) : T(4e-16));
  T opened = T(0), j2m1 = principal_stresses(m.mu, m.kappa, log_v, stress, iso);
  for (int round = 0; round < 40; ++round) {
    TensileStrength<T> f = softens ? tensile_strength(m, s.alpha + opened) : before;
    if (!softens) f.slope = T(0);
    f.slope = min(f.slope, T(kSteepestOpening) * m.kappa);
    T away = T(0), t[3];
    for (int i = 0; i < 3; ++i) away += trial[i] - log_v[i];
    for (int i = 0; i < 3; ++i)
      t[i] = stress[i] + T(2) * m.mu * (trial[i] - log_v[i]) + lambda * away;
    Opening<T> o = cut_off(t, lambda, m.mu, f.value + f.slope * opened, f.slope);
    if (softens && s.alpha + o.sum >= T(0)) {
      o = cut_off(t, lambda, m.mu, T(0), T(0));
      // Steeper than it unloads: what would not get that far without strength is held by it.
      if (s.alpha + o.sum < T(0)) o = cut_off(t, lambda, m.mu, f.value, T(0));
    }
    const T change = abs(o.sum - opened);
    opened = o.sum;
    for (int i = 0; i < 3; ++i) log_v[i] = trial[i] - o.by[i];
    j2m1 = principal_stresses(m.mu, m.kappa, log_v, stress, iso);
    if (!(change > tolerance * (opened + abs(trial[0]) + abs(trial[2])))) break;
  }
  // d as a function of what it was, by Newton's polynomial: principal directions stay.
  T slope[2];
  for (int i = 0; i < 2; ++i) {
    const T apart = y[i] - y[i + 1];
    slope[i] = apart > T(0) ? clamp((iso[i] - iso[i + 1]) / apart, T(-4), T(4)) : T(0);
  }
  const T span = y[0] - y[2];
  const T bend = span > T(1e-30) ? (slope[0] - slope[1]) / span : T(0);
  const Sym3<T> first = add_diagonal(s.d, -y[0]);
  const Sym3<T> second = square(first) + (y[0] - y[1]) * first;
  s.d = deviator(slope[0] * first + bend * second);
  s.j2m1 = j2m1;
  if (softens) {
    // A crack in what is still pressed leaves no gap that pressure could close.
    const T grown = s.alpha + opened, loose = slack * (abs(trial[0]) + abs(trial[2]));
    s.alpha = j2m1 < T(0) - loose ? max(s.alpha, min(grown, T(0))) : min(grown, T(kAlphaMax));
  }
  return true;
}

// Shear beyond max(c f, M p) flows at constant volume.
template <typename T>
GSF_HOST_DEVICE bool slide(const NaccMaterial<T>& m, NaccState<T>& s) {
  using std::sqrt;
  const T slack = kRankineSlack<T>;
  const T q = T(1.224744871391589) * m.mu * sqrt(norm2(s.d));
  const T p = T(-0.5) * m.kappa * s.j2m1;
  const T most =
      max(max(T(0) - m.shear_damage * tensile_strength(m, s.alpha).value, m.friction * p), T(0));
  if (!(q > most * (T(1) + slack))) return false;
  s.d = (most / q) * s.d;
  return true;
}

template <typename T>
GSF_HOST_DEVICE_COLD NaccState<T> rankine_plastic(const NaccMaterial<T>& m, bool softens,
                                                  const ElasticState<T>& from, T alpha) {
  using std::expm1;
  NaccState<T> s{from.d, from.j2m1, alpha, false};
  if (alpha > T(0) && s.j2m1 < T(0)) {  // a gap closes
    const T log_j = log_volume(from), closing = min(T(0) - log_j, alpha);
    s.j2m1 = softens && closing < T(0) - log_j ? expm1(T(2) * (log_j + closing)) : T(0);
    if (softens) s.alpha = alpha - closing;
    s.plastic = true;
  }
  const bool slid = slide(m, s);
  const bool opened = open_cracks(m, softens, s);
  const bool again = opened && slide(m, s);
  s.plastic = s.plastic || slid || opened || again;
  return s;
}

// nacc_return, or what a row with a negative shear damage asks for instead.
template <typename T>
GSF_HOST_DEVICE NaccState<T> brittle_return(const NaccMaterial<T>& m, const NaccOptions<T>& o,
                                            const ElasticState<T>& s, T alpha) {
  if (!(m.shear_damage < T(0))) return nacc_return(m, o, s, alpha);
  alpha = clamp(alpha, T(kAlphaMin), T(kAlphaMax));
  if (rankine_clearly_elastic(m, s, alpha)) return {s.d, s.j2m1, alpha, false};
  const ElasticState<T> yielding = s;
  const NaccMaterial<T> of = m;
  return rankine_plastic(of, o.implicit_alpha, yielding, alpha);
}

}  // namespace gsf
