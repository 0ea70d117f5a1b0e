// What one particle does in a step of the resident solver: its stencil, what it gives to the nodes,
// and its update from what it gathered. The bodies of both back ends' loops.
#pragma once

#include "core/grid.h"
#include "core/return_mapping.h"
#include "core/solver_clock.h"

namespace gsf {

// Range of alpha past zero over which a broken point loses its cohesion for good.
inline constexpr double kWeakening = 0.02;

// Laws a kernel is compiled for: fewer laws, fewer registers.
enum LawSet : int { kElasticOnly = 0, kBrittle = 1, kAnyLaw = 2 };

// Weights at offset o in [0, 1): the stencil of grid.h with f = o + 1/2. `base` stays unset.
template <typename T>
GSF_HOST_DEVICE Stencil<T> stencil_at(const T* offset) {
  Stencil<T> s{};
  for (int axis = 0; axis < 3; ++axis) {
    const T o = offset[axis];
    const T a = T(1) - o, b = o - T(0.5);
    s.f[axis] = o + T(0.5);
    s.w[axis][0] = T(0.5) * a * a;
    s.w[axis][1] = T(0.75) - b * b;
    s.w[axis][2] = T(0.5) * o * o;
  }
  return s;
}

// Momentum given to stencil node n in {0, 1, 2}^3 before its weight: constant + slope n.
template <typename T>
GSF_HOST_DEVICE ParticleMomentum<T> momentum_given(const Stencil<T>& s, const T* velocity,
                                                   const T* slope, T mass, T dx) {
  ParticleMomentum<T> q;
  for (int i = 0; i < 9; ++i) q.slope.m[i] = slope[i] * dx;
  for (int i = 0; i < 3; ++i)
    q.constant[i] = mass * velocity[i] -
                    (q.slope(i, 0) * s.f[0] + q.slope(i, 1) * s.f[1] + q.slope(i, 2) * s.f[2]);
  q.mass = mass;
  return q;
}

// Largest momentum one particle can give along one axis to one node before the weight: nodes lie
// within 1.5 dx of it.
template <typename T>
GSF_HOST_DEVICE T momentum_bound(const T* velocity, const T* slope, T mass, T dx) {
  using std::abs;
  T largest = T(0);
  for (int i = 0; i < 3; ++i) {
    const T row = abs(slope[3 * i]) + abs(slope[3 * i + 1]) + abs(slope[3 * i + 2]);
    const T bound = mass * abs(velocity[i]) + T(1.5) * dx * row;
    largest = bound > largest || !(bound == bound) ? bound : largest;  // keeps NaN
  }
  return largest;
}

// Largest values of the particles of one thread, for the clock.
struct Largest {
  float speed2, wave2, gradient2, bound;
};
GSF_HOST_DEVICE float larger(float a, float b) { return a > b || !(a == a) ? a : b; }

struct StepFlags {
  bool plastic, guarded, inverted, invalid;
  bool leaves;  // close to the end of its window: new blocks are needed before the next step
  bool lost;    // past the end of its window
};

template <typename T>
GSF_HOST_DEVICE NaccMaterial<T> material_now(const SolverView<T>& s, uint32_t row, T peak) {
  NaccMaterial<T> m = load_material(s.rows + int64_t(row) * kRowColumns);
  if (s.irreversible) m.cohesion *= T(1) - clamp(peak / T(kWeakening), T(0), T(1));
  return m;
}

// Speed of the pressure wave in the present state, squared (equations.md 2.1, docs/simulation.md):
// for a uniaxial state of the neo-Hookean law the acoustic modulus is kappa (1 + J^2) / 2 + (2 mu /
// 9) (J^(4/3) + 5 J^(-2/3)).
template <typename T>
GSF_HOST_DEVICE T wave_squared(T mu, T kappa, T density, T j2m1, T log_j) {
  using std::exp;
  const T third = exp(T(2.0 / 3.0) * log_j);  // J^(2/3)
  return (kappa * (T(1) + T(0.5) * j2m1) + T(2.0 / 9.0) * mu * (third * third + T(5) / third)) /
         density;
}

// m C - dt V0 (4 / dx^2) tau.
template <typename T>
GSF_HOST_DEVICE void store_slope(T* out, const Mat3<T>& c, const Sym3<T>& tau, T mass, T volume,
                                 T dx, T dt) {
  const T scale = dt * volume * T(4) / (dx * dx);
  const Mat3<T> t = to_mat3(tau);
  for (int i = 0; i < 9; ++i) out[i] = mass * c.m[i] - scale * t.m[i];
}

// Moves (l, o) of one axis by `step` cells. False when it left the window.
template <typename T>
GSF_HOST_DEVICE bool move_axis(T step, int& l, T& o, bool& leaves) {
  using std::floor;
  const T there = o + step;
  if (!(there > T(-8) && there < T(8))) return false;  // NaN too
  T whole = floor(there);
  T rest = there - whole;
  if (!(rest < T(1))) {  // rounding of a tiny negative number
    rest = T(0);
    whole += T(1);
  }
  const int cell = l + int(whole);
  o = rest;
  l = cell < 0 ? 0 : (cell > kLastCell ? kLastCell : cell);
  const T reached = T(cell) + rest;
  leaves = leaves || reached < T(0.5) || reached > T(kLastCell) + T(0.5);
  return cell >= 0 && cell <= kLastCell;
}

// Update of particle p from what it gathered (value = sum w v_i, first = sum w v_i (node - f), in
// cells): velocity, C, position, deformation, strain by its law, and the slope for the next step.
// `reach` is that of its home: a particle that would touch a block out of reach asks for new ones.
template <typename T, int kLaws, bool kTrack>
GSF_HOST_DEVICE StepFlags finish_particle(const SolverView<T>& s, int64_t p, uint32_t reach,
                                          const T* value, const Mat3<T>& first, T dt, T dt_next,
                                          Largest& largest) {
  StepFlags flags{};
  const T inv_dx = T(1) / s.dx;
  const uint32_t meta = s.meta[p];
  const uint32_t row = meta_row(meta) < uint64_t(s.row_count) ? meta_row(meta) : 0;
  Mat3<T> c;
  for (int i = 0; i < 9; ++i) c.m[i] = T(4) * inv_dx * first.m[i];

  int l[3] = {meta_cell(meta, 0), meta_cell(meta, 1), meta_cell(meta, 2)};
  for (int axis = 0; axis < 3; ++axis) {
    T o = s.offset[3 * p + axis];
    if (!move_axis(dt * inv_dx * value[axis], l[axis], o, flags.leaves)) flags.lost = true;
    flags.leaves = flags.leaves || !cell_in_reach(reach, axis, l[axis]);
    s.offset[3 * p + axis] = o;
    s.velocity[3 * p + axis] = value[axis];
  }
  s.meta[p] = pack_meta(l[0], l[1], l[2], meta_row(meta));

  if constexpr (kTrack) {
    const Mat3<T> f = load_mat3(s.deformation + 9 * p);
    store_mat3(s.deformation + 9 * p, f + dt * matmul(c, f));
  }

  const T* r = s.rows + int64_t(row) * kRowColumns;
  const T mass = r[kMassColumn], volume = r[kVolumeColumn];
  const Mat3<T> increment = dt * c;
  Sym3<T> stress;
  T wave2;
  if constexpr (kLaws == kElasticOnly) {
    const Sym3<T> e = update_strain(load_sym3(s.strain + 6 * p), increment);
    const ElasticState<T> state = elastic_state(e, !(det_identity_plus(increment) > T(0)));
    flags.guarded = state.guarded;
    flags.inverted = state.inverted;
    flags.invalid = !finite(e);
    store_sym3(s.strain + 6 * p,
               state.guarded ? strain_from_isochoric(state.d, state.log_j) : state.e);
    stress = kirchhoff_stress(r[0], r[1], state.d, state.j2m1);
    wave2 = wave_squared(r[0], r[1], r[6], state.j2m1, state.log_j);
  } else {
    const T alpha = s.alpha[p], peak = s.peak[p];
    const ReturnMapped<T> out = return_mapping(load_sym3(s.strain + 6 * p), alpha, increment,
                                               s.law[row], material_now(s, row, peak), s.options);
    flags.plastic = out.plastic;
    flags.guarded = out.guarded;
    flags.inverted = out.inverted;
    flags.invalid = out.invalid;
    store_sym3(s.strain + 6 * p, out.strain);
    s.alpha[p] = out.alpha;
    s.peak[p] = out.alpha > peak ? out.alpha : peak;
    stress = out.stress;
    const T j2m1 = max(det_minus_one(out.strain), T(-0.9999));
    using std::log1p;
    wave2 = wave_squared(r[0], r[1], r[6], j2m1, T(0.5) * log1p(j2m1));
  }
  T slope[9];
  store_slope(slope, c, stress, mass, volume, s.dx, dt_next);
  for (int i = 0; i < 9; ++i) s.slope[9 * p + i] = slope[i];

  T speed2 = T(0), gradient2 = T(0);
  for (int i = 0; i < 3; ++i) speed2 += value[i] * value[i];
  for (int i = 0; i < 9; ++i) gradient2 += c.m[i] * c.m[i];
  bool whole = true;  // broken points carry no stress: how fast they are torn does not matter
  if constexpr (kLaws != kElasticOnly) whole = s.peak[p] < T(0) || s.law[row] != 1;
  largest.speed2 = larger(float(speed2), largest.speed2);
  largest.wave2 = larger(float(wave2), largest.wave2);
  if (whole) largest.gradient2 = larger(float(gradient2), largest.gradient2);
  largest.bound = larger(float(momentum_bound(value, slope, mass, s.dx)), largest.bound);
  return flags;
}

// Start of a call: the slope holds m C (the last step of the call before wrote it with dt_next =
// 0). `measure` only reads speeds; otherwise the stress of the coming step is taken into the slope.
template <typename T>
GSF_HOST_DEVICE void prime_particle(const SolverView<T>& s, int64_t p, bool measure, T dt,
                                    Largest& largest) {
  const uint32_t row = meta_row(s.meta[p]) < uint64_t(s.row_count) ? meta_row(s.meta[p]) : 0;
  const T* r = s.rows + int64_t(row) * kRowColumns;
  const T mass = r[kMassColumn];
  const T alpha = s.alpha != nullptr ? s.alpha[p] : T(0),
          peak = s.peak != nullptr ? s.peak[p] : alpha;
  Mat3<T> c = load_mat3(s.slope + 9 * p);
  const T inverse = mass > T(0) ? T(1) / mass : T(0);
  for (int i = 0; i < 9; ++i) c.m[i] *= inverse;
  const T* v = s.velocity + 3 * p;
  if (measure) {
    const Sym3<T> e = load_sym3(s.strain + 6 * p);
    using std::log1p;
    const T j2m1 = max(det_minus_one(e), T(-0.9999));
    T speed2 = T(0), gradient2 = T(0);
    for (int i = 0; i < 3; ++i) speed2 += v[i] * v[i];
    for (int i = 0; i < 9; ++i) gradient2 += c.m[i] * c.m[i];
    const T wave2 = wave_squared(r[0], r[1], r[6], j2m1, T(0.5) * log1p(j2m1));
    largest.speed2 = larger(float(speed2), largest.speed2);
    largest.wave2 = larger(float(wave2), largest.wave2);
    if (peak < T(0) || s.law[row] != 1)
      largest.gradient2 = larger(float(gradient2), largest.gradient2);
    return;
  }
  const Mat3<T> none{};
  const ReturnMapped<T> state = return_mapping(load_sym3(s.strain + 6 * p), alpha, none, s.law[row],
                                               material_now(s, row, peak), s.options);
  T slope[9];
  store_slope(slope, c, state.stress, mass, r[kVolumeColumn], s.dx, dt);
  for (int i = 0; i < 9; ++i) s.slope[9 * p + i] = slope[i];
  largest.bound = larger(float(momentum_bound(v, slope, mass, s.dx)), largest.bound);
}

}  // namespace gsf
