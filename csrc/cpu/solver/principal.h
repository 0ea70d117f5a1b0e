// Principal strains of packs, without branches; of numbers: core/material/phase_field.h.
#pragma once

#include "core/material/phase_field.h"
#include "cpu/pack.h"

namespace gsf::cpu {

template <typename T>
struct PrincipalOfPack {
  using P = Pack<T>;

  // Jacobi's rotations, largest first. A rotation by tan t = 2 o / (|a| + sqrt(a^2 + 4 o^2)), a the
  // difference of the diagonal, is none where o is nothing.
  Vec3<P> eigenvalues(const Sym3<P>& e) const {
    P a[3] = {e.xx, e.yy, e.zz}, o[3] = {e.yz, e.xz, e.xy};  // o[k]: entry off row and column k
    for (int sweep = 0; sweep < 5; ++sweep)
      for (int k = 0; k < 3; ++k) {
        const int i = (k + 1) % 3, j = (k + 2) % 3;
        const P between = a[j] - a[i], twice = P(2) * o[k];
        const P hypotenuse = max(sqrt(between * between + twice * twice), abs(twice));
        const P size = abs(between) + hypotenuse + P(T(1e-37));
        const P t = select<T>(between < P(0), P(0) - twice, twice) / size;
        const P c = P(1) / sqrt(t * t + P(1)), s = t * c;
        a[i] = a[i] - t * o[k];
        a[j] = a[j] + t * o[k];
        o[k] = P(0);
        const P u = o[i], v = o[j];  // entries (j, k) and (i, k)
        o[j] = c * v - s * u;
        o[i] = s * v + c * u;
      }
    const P hi = max(a[0], max(a[1], a[2])), lo = min(a[0], min(a[1], a[2]));
    return {hi, max(min(a[0], a[1]), min(max(a[0], a[1]), a[2])), lo};
  }
  // ln(1 + y) / y by two roots and the series of the inverse hyperbolic tangent, to rounding for y
  // from -0.75 to 8.
  P log_over(P y) const {
    const P root = sqrt(P(1) + y), w = y / (P(1) + root);
    const P again = sqrt(P(1) + w), v = w / (P(1) + again);
    const P z = v / (P(2) + v), z2 = z * z;
    constexpr int kTerms = 23;
    P sum = P(T(1.0 / double(kTerms)));
    for (int n = kTerms - 2; n >= 1; n -= 2) sum = P(T(1.0 / double(n))) + z2 * sum;
    return P(8) * sum / ((P(1) + root) * (P(1) + again) * (P(2) + v));
  }
  P half_log(P x) const { return P(T(0.5)) * x * log_over(x); }
  P pick(typename P::Int which, P yes, P no) const { return select<T>(which, yes, no); }
};
// Largest |e|^2 for which the above holds: eigenvalues, and their differences over what is left.
inline constexpr double kPrincipalStrain2 = 0.5;

}  // namespace gsf::cpu
