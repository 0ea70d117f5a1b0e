// Inner friction: restitution e of a body that lands whole.
//
// While a point gives back what it stored, only a share e^2 of its stress acts: an elastic
// collision then returns e^2 of its energy, whatever its duration and the step. Nothing is lost
// while it is loaded, or at rest: the share falls from one with the rate of unloading, over the
// rate of sixty cells a wave. Dry matter loses under pressure alone. Wet tissue loses in tension as
// well: what would drive cracks and throw pieces about is spent inside.
#pragma once

#include "core/sym3.h"

namespace gsf {

inline constexpr double kSlowUnloading = 60;  // cells that a wave crosses in 1 / rate

// Share of the stress that acts.
//   loss    1 - e^2 under pressure; 2 - e^2, more than one, in tension too
//   pace    kSlowUnloading times density times wave speed times dx [Pa s]
//   stress  Kirchhoff [Pa], c velocity gradient [1/s]
template <typename T>
GSF_HOST_DEVICE T unloading_share(T loss, T pace, const Sym3<T>& stress, const Mat3<T>& c) {
  using std::sqrt;
  const T size2 = norm2(stress) + T(1e-30);
  const T power = stress.xx * c(0, 0) + stress.yy * c(1, 1) + stress.zz * c(2, 2) +
                  stress.xy * (c(0, 1) + c(1, 0)) + stress.xz * (c(0, 2) + c(2, 0)) +
                  stress.yz * (c(1, 2) + c(2, 1));
  const T anyhow = clamp((loss - T(1)) * T(1e9), T(0), T(1));
  // 1 from uniaxial compression on, 0 without pressure
  const T pressed = max(clamp(T(-1) * trace(stress) / sqrt(size2), T(0), T(1)), anyhow);
  return T(1) - (loss - anyhow) * pressed * clamp(T(0) - pace * power / size2, T(0), T(1));
}

}  // namespace gsf
