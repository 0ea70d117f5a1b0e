// What one particle does in a step of the resident solver: its stencil, what it gives to the nodes,
// and its update from what it gathered. The bodies of both back ends' loops.
#pragma once

#include "core/material/loss.h"
#include "core/material/more_laws.h"
#include "core/material/viscous.h"
#include "core/mpm/grid.h"
#include "core/solver/clock.h"
#include "core/solver/layout.h"

namespace gsf {

// Range of alpha past zero over which a broken point (NACC) loses its cohesion for good.
inline constexpr double kWeakening = 0.02;

// Laws a kernel is compiled for: fewer laws, fewer registers.
// kMoreLaws: those of more_laws.h too (on the CPU solver_more.cpp).
// kDamageField: elastic, NACC and phase_field (cpu/solver/solver_fields.cpp,
// cuda/solver/damage.cu).
// kDamageQuiet: the same matter as long as nothing is near its threshold (CUDA; no kernels of its
// own).
// kViscousBrittle, kViscousAny: as kBrittle, kAnyLaw, with springs beside elastic and NACC matter
// (core/material/viscous.h; on the CPU solver_viscous.cpp).
enum LawSet : int {
  kElasticOnly = 0,
  kBrittle = 1,
  kAnyLaw = 2,
  kMoreLaws = 3,
  kDamageField = 4,
  kViscousBrittle = 5,
  kViscousAny = 6,
  kDamageQuiet = 7
};
constexpr bool with_damage(int64_t laws) { return laws == kDamageField || laws == kDamageQuiet; }
constexpr bool with_springs(int laws) { return laws == kViscousBrittle || laws == kViscousAny; }

// Weights at offset o in [0, 1): the stencil of grid.h with f = o + 1/2. `base` stays unset.
template <typename T>
GSF_HOST_DEVICE Stencil<T> stencil_at(const T* offset) {
  Stencil<T> s{};
  for (int axis = 0; axis < 3; ++axis) {
    const T o = offset[axis];
    const T a = T(1) - o;
    s.f[axis] = o + T(0.5);
    s.w[axis][0] = T(0.5) * a * a;
    s.w[axis][2] = T(0.5) * o * o;
    s.w[axis][1] = T(1) - s.w[axis][0] - s.w[axis][2];  // the sum is one to the last bit
  }
  return s;
}

// Gathers value = sum w v and first = sum w v (node - particle), in cells: along z, then y, then x.
// The weights of an axis sum to one and their first moments to zero, so each sum is taken of
// differences to the middle node: what all nodes share goes through without a rounding, and bodies
// that fly or spin freely keep their momentum longer.
//   node(c, i, j, k)                     component c of the velocity of a stencil node
//   row(middle, w0, below, w2, above)    middle + w0 below + w2 above, in the order that is best
//                                        where it runs: most of the additions are there
template <typename T, typename Node, typename Row>
GSF_HOST_DEVICE void gather_stencil(const Stencil<T>& s, const Node& node, const Row& row, T* value,
                                    Mat3<T>& first) {
  T lever[3][3];  // w (node - particle) of each axis
  for (int axis = 0; axis < 3; ++axis)
    for (int n = 0; n < 3; ++n) lever[axis][n] = s.w[axis][n] * (T(n) - s.f[axis]);
  const T* w = s.w[0];
  // One component at a time: its sums and the weights along z stay in registers.
  for (int c = 0; c < 3; ++c) {
    T plane[3], plane_y[3], plane_z[3];
    for (int i = 0; i < 3; ++i) {
      T line[3], line_z[3];
      for (int j = 0; j < 3; ++j) {
        const T middle = node(c, i, j, 1);
        const T below = node(c, i, j, 0) - middle, above = node(c, i, j, 2) - middle;
        line[j] = row(middle, s.w[2][0], below, s.w[2][2], above);
        line_z[j] = lever[2][0] * below + lever[2][2] * above;
      }
      const T below = line[0] - line[1], above = line[2] - line[1];
      plane[i] = line[1] + (s.w[1][0] * below + s.w[1][2] * above);
      plane_y[i] = lever[1][0] * below + lever[1][2] * above;
      plane_z[i] = s.w[1][0] * line_z[0] + s.w[1][1] * line_z[1] + s.w[1][2] * line_z[2];
    }
    const T below = plane[0] - plane[1], above = plane[2] - plane[1];
    value[c] = plane[1] + (w[0] * below + w[2] * above);
    first(c, 0) = lever[0][0] * below + lever[0][2] * above;
    first(c, 1) = w[0] * plane_y[0] + w[1] * plane_y[1] + w[2] * plane_y[2];
    first(c, 2) = w[0] * plane_z[0] + w[1] * plane_z[1] + w[2] * plane_z[2];
  }
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

// The larger of two values; NaN counts as larger than any.
template <typename T>
GSF_HOST_DEVICE T larger(T a, T b) {
  return a > b || !(a == a) ? a : b;
}
#ifdef __CUDA_ARCH__
// For values that are not negative: their bits sort as they do, and NaN above all.
__device__ inline float larger(float a, float b) {
  return __uint_as_float(max(__float_as_uint(a), __float_as_uint(b)));
}
#endif

// Largest momentum one particle can give along one axis to one node before the weight: nodes lie
// within 1.5 dx of it.
template <typename T>
GSF_HOST_DEVICE T momentum_bound(const T* velocity, const T* slope, T mass, T dx) {
  using std::abs;
  T largest = T(0);
  for (int i = 0; i < 3; ++i) {
    const T row = abs(slope[3 * i]) + abs(slope[3 * i + 1]) + abs(slope[3 * i + 2]);
    largest = larger(mass * abs(velocity[i]) + T(1.5) * dx * row, largest);
  }
  return largest;
}

// Which of the 27 blocks around a home holds the middle of the stencil of a particle.
GSF_HOST_DEVICE int middle_block(uint32_t meta) {
  int n = 0;
  for (int axis = 0; axis < 3; ++axis) n = 3 * n + ((meta_cell(meta, axis) + 3) >> 2);
  return n;
}

// Largest values of the particles of one thread, for the clock.
struct Largest {
  float speed2, wave2, gradient2, bound;
};

struct StepFlags {
  bool plastic, guarded, inverted, invalid;
  bool leaves;  // close to the end of its window: new blocks are needed before the next step
  bool lost;    // past the end of its window
  bool hot;     // its damage is solved for in the next step (kDamageField)
};

template <bool kWithField = false, typename T>
GSF_HOST_DEVICE MaterialRow<T> material_now(const SolverView<T>& s, uint32_t row, T peak) {
  MaterialRow<T> m = load_material(s.rows + int64_t(row) * kRowColumns);
  if (s.irreversible && s.law[row] == kNacc)
    m.cohesion *= T(1) - clamp(peak / T(kWeakening), T(0), T(1));
  if constexpr (kWithField) {
    if (s.law[row] == kPhaseField) m.cohesion = damage_of(peak);
  }
  return m;
}

// wave_speed_squared of the neo-Hookean law where the state's invariants are at hand.
template <typename T>
GSF_HOST_DEVICE T elastic_wave_squared(const T* row, const ElasticState<T>& state) {
  const T mean =
      clamp(state.isochoric * (T(1) + trace(state.e) * T(1.0 / 3.0)), T(1), T(kDeviatorMax));
  const T along = row[0] * (T(4.0 / 3.0) * mean + T(0.272165526975909) * state.n) +
                  T(0.5) * row[1] * (T(2) + state.j2m1);
  const T across = row[0] * (mean + T(0.816496580927726) * state.n);
  return max(along, across) * row[kInverseDensityColumn];
}

// m C - dt V0 (4 / dx^2) tau, from the row of the particle.
template <typename T>
GSF_HOST_DEVICE void store_slope(T* out, const Mat3<T>& c, const Sym3<T>& tau, const T* row, T dt) {
  const T scale = dt * row[kStressColumn];
  const Mat3<T> t = to_mat3(tau);
  for (int i = 0; i < 9; ++i) out[i] = row[kMassColumn] * c.m[i] - scale * t.m[i];
}

// Affine velocity beside a velocity `given` to a particle that moves by `value`: what moves by one
// velocity and has another would change its angular momentum by dt value x given.
template <typename T>
GSF_HOST_DEVICE Mat3<T> spin_beside(const T* value, const T* given, T dt, T inv_dx) {
  const T scale = T(-2) * dt * inv_dx * inv_dx;
  Mat3<T> spin{};
  for (int i = 0; i < 3; ++i) {
    const int j = (i + 1) % 3, k = (i + 2) % 3;
    spin(k, j) = scale * (value[j] * given[k] - value[k] * given[j]);
    spin(j, k) = T(0) - spin(k, j);
  }
  return spin;
}

// What the transfer took of a particle's own motion is given back: `velocity` and `own` hold that
// share of it, and get what the particle has in the end, which is stored.
template <typename T>
GSF_HOST_DEVICE void keep_own(const SolverView<T>& s, int64_t p, const Mat3<T>& c, T mass,
                              const T* value, T dt, T* velocity, T* own, T* slope) {
  const Mat3<T> spin = spin_beside(value, velocity, dt, s.inv_dx);
  for (int i = 0; i < 9; ++i) {
    const T given = own[i] + mass * spin.m[i];
    slope[i] += given;
    own[i] = mass * c.m[i] + given;
  }
  for (int i = 0; i < 3; ++i) velocity[i] += value[i];
  store_nine(s, s.own, p, own);
  store_motion(s, p, velocity, slope);
}

// Moves (l, o) of one axis by `step` cells; `leaves` is set within `slack` cells of the end of the
// window. False when it left the window; a step that is not finite leaves o where it was.
template <typename T>
GSF_HOST_DEVICE bool move_axis(T step, T slack, int& l, T& o, bool& leaves) {
  using std::floor;
  const T there = o + step;
  const bool known = there > T(-8) && there < T(8);  // false for NaN
  T whole = known ? floor(there) : T(-8);
  T rest = there - whole;
  if (!(rest < T(1))) {  // rounding of a tiny negative number
    rest = T(0);
    whole += T(1);
  }
  const int cell = l + int(whole);
  o = known ? rest : o;
  l = cell < 0 ? 0 : (cell > kLastCell ? kLastCell : cell);
  const T reached = T(cell) + rest;
  leaves = leaves || !(reached >= slack && reached <= T(kLastCell + 1) - slack);
  return known && cell >= 0 && cell <= kLastCell;
}

// What is kept of a strain: itself, or where it was pulled back to.
template <typename T>
GSF_HOST_DEVICE Sym3<T> kept_strain(const ElasticState<T>& state) {
  return state.guarded ? strain_from_isochoric(state.d, log_volume(state)) : state.e;
}

// What viscosity makes of the step of a law (core/material/viscous.h): the yield takes its time,
// the Maxwell branch goes along and its spring shares in the stress. A spring that is not finite is
// let go, and the point counts as invalid.
template <typename T>
GSF_HOST_DEVICE void viscous_particle(const SolverView<T>& s, int64_t p, const T* row,
                                      const Sym3<T>& strain, T alpha, const Mat3<T>& increment,
                                      T dt, bool brittle, const MaterialRow<T>& m,
                                      ReturnMapped<T>& out) {
  T own[kViscousColumns];
  load_nine(s, s.viscous, p, own);
  const T share = own[6];
  const T way = yielding_share(own[8], dt);
  if (out.plastic && own[8] > T(0)) {
    const ElasticState<T> trial = elastic_state(update_strain(strain, increment), out.inverted);
    out.strain = (T(1) - way) * kept_strain(trial) + way * out.strain;
    out.alpha = alpha + way * (out.alpha - alpha);
    const ElasticState<T> now = elastic_state(out.strain, false);
    out.strain = kept_strain(now);
    out.stress = kirchhoff_stress(row[0], row[1], now.d, now.j2m1);
  }
  if (!(share > T(0))) return;
  Sym3<T> e{own[0], own[1], own[2], own[3], own[4], own[5]};
  e = relaxed_strain(e, increment, half_decay(max(own[7], T(0)), dt));
  if (own[7] < T(0))
    e = kept_by_unloading(own[7], out.stress, increment, row[1] + T(4.0 / 3.0) * row[0], dt) * e;
  if (!finite(e)) {
    e = Sym3<T>{};
    out.invalid = true;
  }
  ElasticState<T> spring = elastic_state(e, out.inverted);
  if (brittle) {
    const NaccMaterial<T> nacc{m.mu, m.kappa, m.strength, m.cohesion, m.hardening, m.damage};
    e = kept_strain(spring);
    if (yield_spring(nacc, s.options, out.alpha, spring))
      spring = elastic_state(
          (T(1) - way) * e + way * strain_from_isochoric(spring.d, log_volume(spring)), false);
  }
  store_spring(s, p, kept_strain(spring), own);
  out.stress =
      shared_stress(out.stress, kirchhoff_stress(row[0], row[1], spring.d, spring.j2m1), share);
}

// The maps of the laws that a kernel is compiled for.
template <typename T, int kLaws>
GSF_HOST_DEVICE ReturnMapped<T> law_step(const Sym3<T>& strain, T alpha, const Mat3<T>& increment,
                                         int law, const MaterialRow<T>& m, const NaccOptions<T>& o,
                                         T dt) {
  if constexpr (kLaws == kMoreLaws)
    return return_mapping_more(strain, alpha, increment, law, m, o, dt);
  else if constexpr (kLaws == kDamageField)
    return field_mapping(strain, alpha, increment, law, m, o, dt);
  else
    return return_mapping<false>(strain, alpha, increment, law, m, o, dt);
}
template <typename T, int kLaws>
GSF_HOST_DEVICE T law_wave_squared(int law, const MaterialRow<T>& m, const Sym3<T>& strain) {
  if constexpr (kLaws == kMoreLaws)
    return wave_speed_squared_more(law, m, strain);
  else
    return wave_speed_squared(law, m, strain);
}

// What a particle brings into its update; read before the gather, so that memory works meanwhile.
template <typename T>
struct ParticleBefore {
  T offset[3];
  Sym3<T> strain;
  T alpha, peak;
  uint32_t meta, row;
  T velocity[3], own[9];  // of points that keep a share of their own motion
};

template <typename T, int kLaws, bool kKeeps = false>
GSF_HOST_DEVICE ParticleBefore<T> particle_before(const SolverView<T>& s, int64_t p) {
  ParticleBefore<T> b;
  b.meta = load_place(s, p, b.offset);
  b.strain = load_strain(s, p);
  b.row = s.row_of(b.meta);
  if constexpr (kLaws != kElasticOnly) {
    b.alpha = s.alpha[p];
    b.peak = s.peak[p];
  }
  if constexpr (kKeeps) {
    load_speed(s, p, b.velocity);
    load_nine(s, s.own, p, b.own);
  }
  return b;
}

// Of its own motion, leaves the share that a particle keeps of what the transfer alone would take:
// it gathered `value` and `first` from nodes on which nothing acts but what `own` gave to them.
// Velocity and spin keep one share, or angular momentum would not be; what strains keeps another.
template <typename T>
GSF_HOST_DEVICE void leave_share(const SolverView<T>& s, const T* value, const Mat3<T>& first,
                                 ParticleBefore<T>& b) {
  const T mass = s.rows[int64_t(b.row) * kRowColumns + kMassColumn], scale = T(4) * s.inv_dx;
  for (int i = 0; i < 3; ++i) b.velocity[i] = s.kept_speed * (b.velocity[i] - value[i]);
  Mat3<T> lost;
  for (int i = 0; i < 9; ++i) lost.m[i] = b.own[i] - mass * (scale * first.m[i]);
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      b.own[3 * i + j] = s.kept_slope * lost(i, j) + s.kept_across * lost(j, i);
}

// Whether a step looks at wave speeds and gradients: every step for liquids and other laws whose
// wave speed may rise by half in one step, else every kWaveSteps (CFL 0.5 leaves room).
GSF_HOST_DEVICE bool measures_waves(const SolverClock& c, int laws) {
  return laws == kAnyLaw || laws == kMoreLaws || laws == kViscousAny || c.step % kWaveSteps == 0;
}

// Update of particle p from what it gathered (value = sum w v_i, first = sum w v_i (node - f), in
// cells): velocity, C, position, deformation, strain by its law, and the slope for the next step.
// `reach` is that of its home: a particle that would touch a block out of reach asks for new ones.
// kTrack: with the deformation, where there is one. kKeeps: with keep_own, and `before` holds what
// leave_share left.
template <typename T, int kLaws, bool kTrack, bool kKeeps = false>
GSF_HOST_DEVICE StepFlags finish_particle(const SolverView<T>& s, int64_t p,
                                          ParticleBefore<T>& before, uint32_t reach, const T* value,
                                          const Mat3<T>& first, T dt, T dt_next, bool waves,
                                          T slack, Largest& largest) {
  StepFlags flags{};
  const T inv_dx = s.inv_dx;
  const uint32_t meta = before.meta, row = before.row;
  Mat3<T> c;
  for (int i = 0; i < 9; ++i) c.m[i] = T(4) * inv_dx * first.m[i];

  int l[3] = {meta_cell(meta, 0), meta_cell(meta, 1), meta_cell(meta, 2)};
  T o[3];
  for (int axis = 0; axis < 3; ++axis) {
    o[axis] = before.offset[axis];
    if (!move_axis(dt * inv_dx * value[axis], slack, l[axis], o[axis], flags.leaves))
      flags.lost = true;
    flags.leaves = flags.leaves || !cell_in_reach(reach, axis, l[axis]);
  }
  store_place(s, p, o, pack_meta(l[0], l[1], l[2], meta_row(meta)));

  if (kTrack && s.deformation != nullptr) {
    Mat3<T> f;
    load_nine(s, s.deformation, p, f.m);
    f = f + dt * matmul(c, f);
    store_nine(s, s.deformation, p, f.m);
  }

  const T* r = s.rows + int64_t(row) * kRowColumns;
  const Mat3<T> increment = dt * c;
  Sym3<T> stress;
  T wave2 = T(0);
  bool whole = true;  // broken points carry no stress: how fast they are torn does not matter
  if constexpr (kLaws == kElasticOnly) {
    const Sym3<T> e = update_strain(before.strain, increment);
    const ElasticState<T> state = elastic_state(e, !(det_identity_plus(increment) > T(0)));
    flags.guarded = state.guarded;
    flags.inverted = state.inverted;
    flags.invalid = state.guarded && !finite(e);  // what is not finite is out of bounds
    store_strain(s, p, state.guarded ? strain_from_isochoric(state.d, log_volume(state)) : state.e);
    stress = kirchhoff_stress(r[0], r[1], state.d, state.j2m1);
    if (waves) wave2 = elastic_wave_squared(r, state);
  } else {
    const T alpha = before.alpha, peak = before.peak;
    const MaterialRow<T> material = material_now<kLaws == kDamageField>(s, row, peak);
    const int law = kLaws == kBrittle || kLaws == kViscousBrittle
                        ? (s.law[row] == kNacc ? kNacc : kElastic)
                        : s.law[row];
    ReturnMapped<T> out =
        law_step<T, kLaws>(before.strain, alpha, increment, law, material, s.options, dt);
    if constexpr (with_springs(kLaws))
      if (law == kElastic || law == kNacc)
        viscous_particle(s, p, r, before.strain, alpha, increment, dt, law == kNacc, material, out);
    flags.plastic = out.plastic;
    flags.guarded = out.guarded;
    flags.inverted = out.inverted;
    flags.invalid = out.invalid;
    store_strain(s, p, out.strain);
    if (out.alpha != alpha) {
      s.alpha[p] = out.alpha;
      if (out.alpha > peak && law == kNacc) s.peak[p] = out.alpha;
    }
    bool loses = law == kNacc;
    whole = max(out.alpha, peak) < T(0) || law != kNacc;
    if constexpr (kLaws == kDamageField) {
      loses = loses || law == kPhaseField;
      if (law == kPhaseField) {
        whole = peak < T(0);
        flags.hot = takes_part(out.alpha, peak, active_alpha<T>(is_at2(material)));
      }
    }
    stress = out.stress;
    if (loses && material.exponent > T(0))
      stress = unloading_share(material.exponent, r[kPaceColumn], stress, c) * stress;
    if (waves) wave2 = law_wave_squared<T, kLaws>(law, material, out.strain);
  }
  T slope[9];
  store_slope(slope, c, stress, r, dt_next);
  const T* velocity = value;
  if constexpr (kKeeps) {
    keep_own(s, p, c, r[kMassColumn], value, dt, before.velocity, before.own, slope);
    velocity = before.velocity;
    const T own = momentum_bound(velocity, before.own, r[kMassColumn], s.dx);
    largest.bound = larger(float(own), largest.bound);
  } else {
    store_motion(s, p, value, slope);
  }

  const T speed2 = value[0] * value[0] + value[1] * value[1] + value[2] * value[2];
  largest.speed2 = larger(float(speed2), largest.speed2);
  if (waves) {
    T gradient2 = T(0);
    for (int i = 0; i < 9; ++i) gradient2 += c.m[i] * c.m[i];
    largest.wave2 = larger(float(wave2), largest.wave2);
    if (whole) largest.gradient2 = larger(float(gradient2), largest.gradient2);
  }
  largest.bound =
      larger(float(momentum_bound(velocity, slope, r[kMassColumn], s.dx)), largest.bound);
  return flags;
}

// The same with everything read here.
template <typename T, int kLaws, bool kTrack, bool kKeeps = false>
GSF_HOST_DEVICE StepFlags finish_particle(const SolverView<T>& s, int64_t p, uint32_t reach,
                                          const T* value, const Mat3<T>& first, T dt, T dt_next,
                                          Largest& largest) {
  ParticleBefore<T> before = particle_before<T, kLaws, kKeeps>(s, p);
  return finish_particle<T, kLaws, kTrack, kKeeps>(s, p, before, reach, value, first, dt, dt_next,
                                                   measures_waves(*s.clock, kLaws),
                                                   T(s.clock->slack), largest);
}

// Start of a call: the slope holds m C (the last step of the call before wrote it with dt_next =
// 0). `measure` only reads speeds; otherwise the stress of the coming step is taken into the slope.
template <typename T, int kLaws = kAnyLaw>
GSF_HOST_DEVICE void prime_particle(const SolverView<T>& s, int64_t p, bool measure, T dt,
                                    Largest& largest) {
  const uint32_t meta = load_meta(s, p);
  const uint32_t row = s.row_of(meta);
  const T* r = s.rows + int64_t(row) * kRowColumns;
  const T mass = r[kMassColumn];
  const T alpha = s.alpha != nullptr ? s.alpha[p] : T(0),
          peak = s.peak != nullptr ? s.peak[p] : alpha;
  Mat3<T> c;
  T v[3];
  load_motion(s, p, v, c.m);
  T bound = T(0);
  if (!measure && s.own != nullptr) {  // m C, still without stress
    store_nine(s, s.own, p, c.m);
    bound = momentum_bound(v, c.m, mass, s.dx);
  }
  const T inverse = mass > T(0) ? T(1) / mass : T(0);
  for (int i = 0; i < 9; ++i) c.m[i] *= inverse;
  if (measure) {
    T speed2 = T(0), gradient2 = T(0);
    for (int i = 0; i < 3; ++i) speed2 += v[i] * v[i];
    for (int i = 0; i < 9; ++i) gradient2 += c.m[i] * c.m[i];
    const T wave2 = law_wave_squared<T, kLaws>(s.law[row], load_material(r), load_strain(s, p));
    largest.speed2 = larger(float(speed2), largest.speed2);
    largest.wave2 = larger(float(wave2), largest.wave2);
    if (peak < T(0) || s.law[row] != kNacc)
      largest.gradient2 = larger(float(gradient2), largest.gradient2);
    return;
  }
  const Mat3<T> none{};
  const MaterialRow<T> material = material_now<kLaws == kDamageField>(s, row, peak);
  // What flows with a viscosity does so in steps: between them its stress is that of its strain.
  const T span = kLaws == kMoreLaws ? T(0) : dt;
  ReturnMapped<T> state =
      law_step<T, kLaws>(load_strain(s, p), alpha, none, s.law[row], material, s.options, span);
  const bool loses = s.law[row] == kNacc || (kLaws == kDamageField && s.law[row] == kPhaseField);
  if (s.law[row] == kFluid && material.strength > T(0)) {  // its strain moves in a step, not here
    using std::sqrt;
    const T stretched = T(1) + state.strain.xx;
    state.stress =
        state.stress + newtonian_stress(stretched * sqrt(stretched) * material.strength, c);
  }
  if constexpr (with_springs(kLaws))
    if (s.law[row] == kElastic || s.law[row] == kNacc)
      viscous_particle(s, p, r, load_strain(s, p), alpha, none, T(0), s.law[row] == kNacc, material,
                       state);
  if (loses && material.exponent > T(0))
    state.stress =
        unloading_share(material.exponent, r[kPaceColumn], state.stress, c) * state.stress;
  T slope[9];
  store_slope(slope, c, state.stress, r, dt);
  store_motion(s, p, v, slope);
  bound = larger(momentum_bound(v, slope, mass, s.dx), bound);
  largest.bound = larger(float(bound), largest.bound);
}

}  // namespace gsf
