// The way back to the surface of a point without strength (alpha >= 0) that stays so: nacc_plastic
// of nacc.h without its search, branches and logarithms, for packs of numbers (cpu/pack.h).
// tests/ops/test_solver_cpu.py holds the two together.
#pragma once

#include "core/material/nacc.h"
#include "core/material/phase_field.h"

namespace gsf {

inline constexpr double kSoftenedVolume = 0.1;  // largest |J^2 - 1| of a trial state done here
inline constexpr double kSoftenedShear = 0.5;   // largest |d| of what it becomes

// ln (1 + x) for |x| <= 0.1 by its series in x / (2 + x).
template <typename T>
GSF_HOST_DEVICE T log1p_series(T x) {
  const T s = x / (T(2) + x), s2 = s * s;
  T sum = T(1.0 / 13.0);
  for (int n = 11; n >= 1; n -= 2) sum = T(1.0 / double(n)) + s2 * sum;
  return T(2) * s * sum;
}

// (1 + x)^(-1/3) - 1 for |x| <= 0.1: inverse_cube_root_minus_one of elastic.h.
template <typename T>
GSF_HOST_DEVICE T inverse_cube_root_series(T x) {
  T z = x * (T(-1.0 / 3.0) + x * (T(2.0 / 9.0) - x * T(14.0 / 81.0)));
  for (int i = 0; i < 2; ++i) {
    const T cubed = z * (T(3) + z * (T(3) + z));
    z -= T(1.0 / 3.0) * (T(1) + z) * (cubed + x * (T(1) + cubed));
  }
  return z;
}

template <typename T>
struct Softened {
  Sym3<T> strain;  // returned elastic strain b' - I
  Sym3<T> d;       // its isochoric deviator
  T j2m1, isochoric;
  T n2;       // |d|^2
  T step;     // of alpha; where it leads below zero the point regains strength: not done here
  T outside;  // u^2 + w^2 - 1 of the trial state: above zero it yields
};

// nacc_project and alpha_step at one surface, k = 2.
template <typename T>
struct PackReturn {
  T cross, back;  // where the return line meets the surface, and the returned pressure [kappa]
  T r;            // factor on the deviator
  T step;         // of alpha
  T outside;      // u^2 + w^2 - 1 of the trial state: above zero it yields
};

// From the trial state (n = |d|, J^2 - 1) to the surface of compressive tip `p0`, with `epsilon` of
// NaccOptions. Pressures are in units of kappa; ln J by its series, which |2 cross| must be below.
template <typename T>
GSF_HOST_DEVICE PackReturn<T> return_to(const NaccMaterial<T>& m, T epsilon, T p0, T n, T j2m1,
                                        T log_j2) {
  using std::sqrt;
  const T beta = min(m.cohesion, T(kCohesionMax)), tip = -beta * p0;
  const T middle = T(0.5) * (T(1) - beta) * p0, a = T(0.5) * (T(1) + beta) * p0;
  const T b = m.friction * a / sqrt(T(1) + T(2) * beta);
  const T p = T(-0.5) * j2m1, q = T(1.224744871391589) * (m.mu / m.kappa) * n;
  const T u = clamp((p - middle) / a, T(-1e4), T(1e4));
  const T w = min(q / max(b, T(1e-8)), T(1e6));
  // nacc_project
  const T near = clamp(u, T(-1), T(1));
  const T center = (T(1) - epsilon) * (near * near * near);
  const T gap = u - center, g = T(1) - center * center;
  const T t = min(T(1), g / max(center * gap + sqrt(gap * gap + w * w * g), T(1e-30)));
  PackReturn<T> out;
  out.cross = middle + a * (center + t * gap);
  const T inside = clamp(p, tip, p0);
  out.back = clamp(out.cross, min(inside, T(0)), max(inside, T(0)));
  const T beside = sqrt(max((p0 - out.back) * (out.back - tip), T(0))) / a;
  out.r = min(T(1), b * select(out.back == out.cross, t * w, beside) / max(q, T(1e-30)));
  out.outside = u * u + w * w - T(1);
  // alpha_step
  const T volume = T(0.5) * (log_j2 - log1p_series(T(-2) * out.cross));
  const T shear = m.shear_damage * (T(1) - out.r) * n * T(0.4082482904638631);
  out.step = clamp(volume + shear, T(-kAlphaStepMax), T(kAlphaStepMax));
  return out;
}

// The state on the surface: strain_from_isochoric.
template <typename T>
GSF_HOST_DEVICE Softened<T> returned_state(const PackReturn<T>& found, const Sym3<T>& d) {
  Softened<T> out;
  out.outside = found.outside;
  out.step = found.step;
  out.d = found.r * d;
  out.n2 = norm2(out.d);
  out.j2m1 = T(-2) * found.back;
  const T z = inverse_cube_root_series(out.j2m1), y = unit_det_shift_small(out.d);
  const T s = -z / (T(1) + z);  // J^(2/3) - 1
  out.isochoric = T(1) + z;
  out.strain = add_diagonal((T(1) + s) * out.d, y + s * (T(1) + y));
  return out;
}

template <typename T>
GSF_HOST_DEVICE Softened<T> softened_return(const NaccMaterial<T>& m, T epsilon, const Sym3<T>& d,
                                            T n, T j2m1) {
  const T p0 = T(kYieldPressureFloor);
  return returned_state(return_to(m, epsilon, p0, n, j2m1, log1p_series(j2m1)), d);
}

}  // namespace gsf
