// The way back to the surface of points that have strength: nacc_plastic of nacc.h with its search
// for alpha (solve_alpha), a point per lane, which all look until the last has found.
// tests/ops/test_solver_cpu.py holds the two together.
#pragma once

#include "core/material/nacc_softened.h"
#include "cpu/pack.h"

namespace gsf::cpu {

// Largest xi |alpha| of a surface done here: the series of sinh is exact to rounding there.
template <typename T>
inline constexpr double kPackSize = sizeof(T) == 4 ? 1.0 : 0.15;

template <typename T>
struct Yielded {
  Softened<Pack<T>> state;
  Pack<T> alpha;
  typename Pack<T>::Int good;  // where the series used here hold
};

// `lanes` are those that are asked for; what the others get says nothing.
template <typename T>
Yielded<T> yield_pack(const NaccMaterial<Pack<T>>& m, Pack<T> epsilon, const Sym3<Pack<T>>& d,
                      Pack<T> n, Pack<T> j2m1, Pack<T> alpha, typename Pack<T>::Int lanes) {
  using P = Pack<T>;
  using Int = typename P::Int;
  const P log_j2 = log1p_series(j2m1);
  const auto size = [&](P x) { return m.hardening * max(P(0) - x, P(0)); };
  const auto at = [&](P x) {
    const P y = min(size(x), P(kPackSize<T>)), y2 = y * y;
    const P tail = P(1.0 / 120.0) + y2 * (P(1.0 / 5040.0) + y2 * P(1.0 / 362880.0));
    const P sinh = y * (P(1) + y2 * (P(1.0 / 6.0) + y2 * tail));
    const P p0 = min(P(kYieldPressureFloor) + sinh, P(kYieldPressureCap));
    return return_to(m, epsilon, p0, n, j2m1, log_j2);
  };
  const auto residual = [&](P x) { return (x - alpha) - at(x).step; };

  const PackReturn<P> begun = at(alpha);
  const P first = begun.step;
  const P tolerance =
      P(sizeof(T) == 4 ? 4.8e-7 : 8.8e-16) * (abs(alpha) + abs(first) + P(0.5) * abs(log_j2));
  const P far = alpha + select<T>(first > P(0), P(kAlphaStepMax), P(-kAlphaStepMax));
  const Int wanted = lanes & (abs(first) > tolerance);
  P x0 = alpha, f0 = P(0) - first, x1 = alpha + first, f1 = residual(x1);
  const auto keep = [](Int where, P& to, P from) { to = select<T>(where, from, to); };
  for (int i = 0; i < 40; ++i) {
    const Int busy = wanted & (f0 * f1 > P(0)) & (abs(f1) > tolerance) & ~(x1 == far);
    if (mask_bits(busy) == 0) break;
    const P last = x1 - x0, change = f0 - f1;
    const P ratio = select<T>(change == P(0), P(4), f1 / change);
    const P step = last * select<T>(ratio > P(0), clamp(ratio, P(1), P(4)), P(4));
    const P next = select<T>(abs(x1 + step - alpha) < P(kAlphaStepMax), x1 + step, far);
    keep(busy, x0, x1);
    keep(busy, f0, f1);
    keep(busy, x1, next);
    keep(busy, f1, residual(next));
  }
  P before = abs(f1);
  for (int i = 0; i < 60; ++i) {
    const Int busy = wanted & (abs(f1) > tolerance) & (abs(x1 - x0) > tolerance);
    if (mask_bits(busy) == 0) break;
    P x = x1 - f1 * (x1 - x0) / (f1 - f0);
    const P lo = min(x0, x1), hi = max(x0, x1);
    Int off = ~((x > lo) & (x < hi));
    if ((i & 7) == 7) {
      off |= abs(f1) > P(0.1) * before;
      before = abs(f1);
    }
    x = select<T>(off, P(0.5) * (lo + hi), x);
    const P f = residual(x);
    const Int other = f * f1 < P(0);
    const P scale = P(1) - f / f1;
    const P less = f0 * select<T>(scale > P(0), scale, P(0.5));
    keep(busy, f0, select<T>(other, f1, less));
    keep(busy & other, x0, x1);
    keep(busy, x1, x);
    keep(busy, f1, f);
  }
  Yielded<T> out;
  out.alpha = clamp(x1, P(kAlphaMin), P(kAlphaMax));
  const PackReturn<P> found = at(out.alpha);
  out.state = returned_state(found, d);
  out.state.outside = begun.outside;
  out.good = (abs(found.cross) <= P(0.5 * kSoftenedVolume)) & (size(alpha) <= P(kPackSize<T>)) &
             (size(out.alpha) <= P(kPackSize<T>));
  return out;
}

}  // namespace gsf::cpu
