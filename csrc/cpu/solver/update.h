// Update of a packet of particles as long as they are elastic, or yield without strength. Whatever
// a lane's particle does beyond that is left to finish_particle (core/solver/particle.h), which
// this file repeats without branches; tests/ops/test_solver_cpu.py holds the two together.
#pragma once

#include "core/material/nacc_softened.h"
#include "core/material/rankine.h"
#include "cpu/solver/packet.h"
#include "cpu/solver/principal.h"
#include "cpu/solver/yield.h"

namespace gsf::cpu {

// Largest squares of the particles done in packets.
template <typename T>
struct PacketLargest {
  Pack<T> speed2{0}, wave2{0}, gradient2{0};

  void give(Largest& l) const {
    l.speed2 = larger(float(largest_lane(speed2)), l.speed2);
    l.wave2 = larger(float(largest_lane(wave2)), l.wave2);
    l.gradient2 = larger(float(largest_lane(gradient2)), l.gradient2);
  }
};

// Elastic trial state inside the NACC yield surface for certain: in units of kappa, with the lower
// bound x + x^3/6 + x^5/120 for sinh x (the surface grows with p0 and contains the origin).
template <typename T>
typename Pack<T>::Int surely_elastic(const Pack<T>* row, Pack<T> cohesion, Pack<T> alpha,
                                     Pack<T> j2m1, Pack<T> n2) {
  using P = Pack<T>;
  const P beta = min(cohesion, P(kCohesionMax));
  const P x = min(row[4] * max(P(0) - alpha, P(0)), P(5));
  const P x2 = x * x;
  const P below = x * (P(1) + x2 * (P(1.0 / 6.0) + x2 * P(1.0 / 120.0)));
  const P p0 = min(P(kYieldPressureFloor) + below, P(kYieldPressureCap));
  const P p = P(-0.5) * j2m1 - P(0.5) * (P(1) - beta) * p0, a = P(0.5) * (P(1) + beta) * p0;
  const P m2 = row[2] * row[2], b2 = m2 * a * a, flat = P(1) + P(2) * beta;
  const P mu = row[0] / row[1], q2 = P(1.5) * mu * mu * n2;
  // u^2 + w^2 < 1 times (M A)^2. Written so that NaN means no; alpha out of its bounds is for the
  // full map to clamp, and so is a surface without height.
  typename P::Int inside = (m2 * p * p + flat * q2 <= P(0.9999) * b2) & (b2 > P(1e-16) * flat);
  const typename P::Int cut = row[5] < P(0);
  if (mask_bits(cut) != 0) {  // rankine_clearly_elastic
    const P f = cohesion * below, mean = P(0.5) * j2m1, shear = mu * sqrt(n2);
    const P most = max(P(0) - row[5] * f, P(0) - row[2] * mean);
    const auto holds = (mean + P(kLargestTension) * shear < P(0.9999) * f) &
                       (P(1.224744871391589) * shear < P(0.9999) * most) &
                       ~((alpha > P(0)) & (mean < P(0)));
    inside = (inside & ~cut) | (holds & cut);
  }
  return inside & (alpha >= P(kAlphaMin)) & (alpha <= P(kAlphaMax));
}

// As far beyond the surface nacc_plastic begins to yield.
template <typename T>
inline constexpr double kYieldSlack = sizeof(T) == 4 ? 1e-6 : 2e-15;

// finish_particle for every active lane.
template <typename T, int kLaws, bool kTrack, bool kKeeps, typename Count>
void finish_packet(const SolverView<T>& s, const Packet<T>& packet, uint32_t reach,
                   const Pack<T>* offset, const PacketGathered<T>& gathered, T dt, T dt_next,
                   PacketLargest<T>& largest, Count& counts) {
  const Pack<T>* value = gathered.value;
  const Mat3<Pack<T>>& first = gathered.first;
  using P = Pack<T>;
  using Int = typename P::Int;
  const T inv_dx = s.inv_dx, slack = T(s.clock->slack);
  Mat3<P> c;
  for (int i = 0; i < 9; ++i) c.m[i] = P(T(4) * inv_dx) * first.m[i];

  using Word = std::conditional_t<sizeof(T) == 4, int32_t, int64_t>;
  const Int meta = int_pack_of<T>([&](int lane) { return Word(packet.meta[lane]); });
  Int plain = packet.used_lanes(), leaves{}, moved = meta & ~(Int{} + 511);
  P rest[3];
  for (int axis = 0; axis < 3; ++axis) {
    const P there = offset[axis] + P(dt * inv_dx) * value[axis];
    plain &= (there > P(-8)) & (there < P(8));
    Int whole;
    const P below = floor(there, whole);
    const P part = there - below;
    const Int up = part >= P(1);  // rounding of a tiny negative number
    rest[axis] = select<T>(up, P(0), part);
    const Int cell = ((meta >> (3 * axis)) & 7) + whole - up;
    plain &= (cell >= 0) & (cell <= kLastCell);
    const P reached = P(__builtin_convertvector(cell, typename P::Raw)) + rest[axis];
    leaves |= (reached < P(slack)) | (reached > P(T(kLastCell + 1) - slack));
    if ((reach >> axis & 1u) == 0) leaves |= cell < 1;
    if ((reach >> (3 + axis) & 1u) == 0) leaves |= cell > 2;
    moved |= cell << (3 * axis);
  }

  const auto row_of = [&](int lane) { return int64_t(s.row_of(packet.meta[lane])); };
  P row[kRowColumns];
  if (packet.same_rows()) {
    for (int i = 0; i < kRowColumns; ++i) row[i] = P(s.rows[row_of(0) * kRowColumns + i]);
  } else {
    packet.load_rows(s, row);
  }

  Mat3<P> increment;
  for (int i = 0; i < 9; ++i) increment.m[i] = P(dt) * c.m[i];
  Sym3<P> e = update_strain(packet.load6(s.strain), increment);
  P j2m1 = det_minus_one(e);
  P isochoric = reciprocal_cube_root(P(1) + j2m1);
  Sym3<P> d = isochoric * deviator(e);
  P n2 = norm2(d);
  plain &= (max_abs(e) <= P(kStrainMax)) & (j2m1 >= P(kJMin * kJMin - 1.0)) &
           (j2m1 <= P(kJMax * kJMax - 1.0)) & (n2 <= P(kDeviatorMax * kDeviatorMax)) &
           (det_identity_plus(increment) > P(0));
  const auto mix = [](Int mask, Sym3<P>& to, const Sym3<P>& from) {
    to = {select<T>(mask, from.xx, to.xx), select<T>(mask, from.yy, to.yy),
          select<T>(mask, from.zz, to.zz), select<T>(mask, from.xy, to.xy),
          select<T>(mask, from.xz, to.xz), select<T>(mask, from.yz, to.yz)};
  };
  Int whole = Int{} - 1;  // not broken
  Int softens{};          // yields without strength
  [[maybe_unused]] P alpha_after(0), peak_after(0);
  P loss(0);
  Int phase{};
  [[maybe_unused]] Int forgets{};    // broken, and beyond what it remembers
  [[maybe_unused]] Int principal{};  // of a split by principal strains
  P damage(0), history(0), all(0), rankine(0);
  if constexpr (kLaws == kDamageField) {
    phase =
        -int_pack_of<T>([&](int lane) { return Word(s.law[row_of(lane)] == int(kPhaseField)); });
    if (mask_bits(phase) != 0) {
      const P peak = packet.load1(s.peak);
      damage = clamp(peak + P(kBrokenDamage), P(0), P(1));
      history = packet.load1(s.alpha);
      // without a split of principal strains, and what the series hold
      const P split =
          pack_of<T>([&](int lane) { return T(int(s.rows[row_of(lane) * kRowColumns + 5]) & 3); });
      const Int broken = phase & (damage >= P(kBrokenDamage));
      const Int opens = broken & (j2m1 > P(kBrokenVolumeMax)),
                shears = broken & (n2 > P(kBrokenShearMax * kBrokenShearMax));
      forgets = opens | shears;
      if (mask_bits(forgets) != 0) {
        mix(shears, d, P(kBrokenShearMax) / sqrt(n2) * d);
        n2 = select<T>(shears, P(kBrokenShearMax * kBrokenShearMax), n2);
        j2m1 = select<T>(opens, P(kBrokenVolumeMax), j2m1);
        isochoric = select<T>(opens, P(kBrokenIsochoric), isochoric);
        const P stretch = P(1) / isochoric;
        mix(forgets, e,
            add_diagonal(stretch * d, (stretch - P(1)) + stretch * unit_det_shift_small(d)));
      }
      principal = phase & (split > P(1.5)) & (norm2(e) <= P(kPrincipalStrain2)) &
                  ~(broken & (j2m1 >= P(kBrokenVolumeMax)));
      rankine = select<T>(split > P(2.5), P(1), P(0));
      plain &= ~phase | principal |
               ((split < P(1.5)) & (n2 <= P(0.25)) & (j2m1 < P(kSeriesOpen)) &
                (j2m1 > P(kSeriesPressed)));
      all = select<T>(split > P(0.5), P(1), P(0));
      whole = ~phase | (peak < P(0));
      loss = select<T>(phase, row[7], P(0));
    }
  }
  [[maybe_unused]] Int brittle{};
  [[maybe_unused]] P holding(0);  // cohesion of what is brittle
  if constexpr (kLaws != kElasticOnly) {
    Int nacc{}, elastic = phase;
    if (packet.same_rows()) {
      nacc -= s.law[row_of(0)] == int(kNacc) ? 1 : 0;
      elastic |= -Int{} - (s.law[row_of(0)] == int(kElastic) ? 1 : 0);
    } else {
      nacc = -int_pack_of<T>([&](int lane) { return Word(s.law[row_of(lane)] == int(kNacc)); });
      elastic |=
          -int_pack_of<T>([&](int lane) { return Word(s.law[row_of(lane)] == int(kElastic)); });
    }
    plain &= nacc | elastic;
    if (mask_bits(nacc) != 0) {
      const P alpha = packet.load1(s.alpha), peak = packet.load1(s.peak);
      P cohesion = row[3];
      if (s.irreversible) cohesion *= P(1) - clamp(peak * P(1.0 / kWeakening), P(0), P(1));
      const Int holds = surely_elastic(row, cohesion, alpha, j2m1, n2);
      whole &= ~nacc | (peak < P(0));
      softens = plain & nacc & ~holds & (alpha >= P(0)) & (alpha <= P(kAlphaMax)) &
                (abs(j2m1) <= P(kSoftenedVolume)) & (row[2] >= P(kFrictionMin)) & (row[5] >= P(0));
      if constexpr (with_springs(kLaws))  // a yield that takes time is for the full map
        softens &= packet.load1(s.viscous, kViscousColumns, kViscousColumns - 1) <= P(0);
      alpha_after = alpha;
      if (s.options.k == T(2) && mask_bits(softens) != 0) {
        const NaccMaterial<P> m{row[0], row[1], row[2], cohesion, row[4], row[5]};
        const Softened<P> now = softened_return(m, P(s.options.epsilon), d, sqrt(n2), j2m1);
        softens &= (now.outside > P(kYieldSlack<T>)) & (alpha + now.step >= P(0)) &
                   (now.n2 <= P(kSoftenedShear * kSoftenedShear));
        mix(softens, e, now.strain);
        mix(softens, d, now.d);
        j2m1 = select<T>(softens, now.j2m1, j2m1);
        isochoric = select<T>(softens, now.isochoric, isochoric);
        n2 = select<T>(softens, now.n2, n2);
        alpha_after = select<T>(softens, min(alpha + now.step, P(kAlphaMax)), alpha);
        peak_after = max(peak, alpha_after);
        whole &= ~softens;
      } else {
        softens = Int{};
      }
      // with strength
      Int yields = plain & nacc & ~holds & ~softens & (alpha >= P(kAlphaMin)) &
                   (alpha <= P(kAlphaMax)) & (abs(j2m1) <= P(kSoftenedVolume)) &
                   (row[2] >= P(kFrictionMin)) & (row[5] >= P(0));
      if constexpr (with_springs(kLaws))
        yields &= packet.load1(s.viscous, kViscousColumns, kViscousColumns - 1) <= P(0);
      if (s.options.k == T(2) && s.options.implicit_alpha && mask_bits(yields) != 0) {
        const NaccMaterial<P> m{row[0], row[1], row[2], cohesion, row[4], row[5]};
        const Yielded<T> now =
            yield_pack<T>(m, P(s.options.epsilon), d, sqrt(n2), j2m1, alpha, yields);
        yields &= now.good & (now.state.outside > P(kYieldSlack<T>)) &
                  (now.state.n2 <= P(kSoftenedShear * kSoftenedShear));
        mix(yields, e, now.state.strain);
        mix(yields, d, now.state.d);
        j2m1 = select<T>(yields, now.state.j2m1, j2m1);
        isochoric = select<T>(yields, now.state.isochoric, isochoric);
        n2 = select<T>(yields, now.state.n2, n2);
        alpha_after = select<T>(yields, now.alpha, alpha_after);
        peak_after = select<T>(yields, max(peak, now.alpha), peak_after);
        whole &= ~yields | (peak_after < P(0));
        softens |= yields;
      }
      plain &= ~nacc | softens | (holds & (alpha <= peak));
      loss = select<T>(nacc, row[7], loss);
      brittle = nacc;
      holding = cohesion;
    }
  }

  Sym3<P> stress = add_diagonal(row[0] * d, P(0.5) * row[1] * j2m1);
  if constexpr (kLaws == kDamageField) {
    if (mask_bits(phase) != 0) {
      const PhaseState<P> now = phase_state(row[0], row[1], damage, all, d, unit_det_shift_small(d),
                                            j2m1, [](P x) { return volume_series(x); });
      mix(phase, stress, now.stress);
      const P before = history;
      history = max(history, min(now.active / row[2], P(kDriveMax)) - P(1));
      if (mask_bits(principal) != 0) {
        history = select<T>(principal, before, history);
        Int known = principal & (damage <= P(0)) & (norm2(e) <= P(kWholeStrain2));
        const PhaseState<P> intact = phase_state_whole(row[0], row[1], rankine, e);
        known &= intact.active <= (before + P(1)) * row[2];
        mix(known, stress, intact.stress);
        const Int rest = principal & ~known;
        if (mask_bits(rest) != 0) {
          const PhaseState<P> split =
              phase_state_spectral(row[0], row[1], damage, rankine, e, PrincipalOfPack<T>{});
          mix(rest, stress, split.stress);
          const P now = max(before, min(split.active / row[2], P(kDriveMax)) - P(1));
          history = select<T>(rest, now, history);
        }
      }
    }
  }
  [[maybe_unused]] Sym3<P> spring;
  [[maybe_unused]] Int relaxes{};
  if constexpr (with_springs(kLaws)) {
    P four[8];
    packet.load4(s.viscous, kViscousColumns, 0, four);
    packet.load4(s.viscous, kViscousColumns, 4, four + 4);
    relaxes = four[6] > P(0);
    spring = relaxed_strain(Sym3<P>{four[0], four[1], four[2], four[3], four[4], four[5]},
                            increment, half_decay(max(four[7], P(0)), P(dt)));
    if (mask_bits(four[7] < P(0)) != 0)
      spring = select<T>(four[7] < P(0),
                         kept_by_unloading(four[7], stress, increment,
                                           row[1] + P(4.0 / 3.0) * row[0], P(dt)),
                         P(1)) *
               spring;
    P change = det_minus_one(spring);
    Sym3<P> away = reciprocal_cube_root(P(1) + change) * deviator(spring);
    const P away2 = norm2(away);
    plain &=
        ~relaxes | ((max_abs(spring) <= P(kStrainMax)) & (change >= P(kJMin * kJMin - 1.0)) &
                    (change <= P(kJMax * kJMax - 1.0)) & (away2 <= P(kDeviatorMax * kDeviatorMax)));
    Int held = ~(relaxes & brittle) | surely_elastic(row, holding, alpha_after, change, away2);
    // yield_spring, of what has no strength
    Int slips = plain & ~held & (alpha_after >= P(0)) & (abs(change) <= P(kSoftenedVolume)) &
                (row[2] >= P(kFrictionMin)) & (row[5] >= P(0));
    if (s.options.k == T(2) && mask_bits(slips) != 0) {
      const NaccMaterial<P> m{row[0], row[1], row[2], holding, row[4], row[5]};
      const Softened<P> now = softened_return(m, P(s.options.epsilon), away, sqrt(away2), change);
      slips &= (now.outside > P(kYieldSlack<T>)) & (now.n2 <= P(kSoftenedShear * kSoftenedShear));
      mix(slips, spring, now.strain);
      mix(slips, away, now.d);
      change = select<T>(slips, now.j2m1, change);
      held |= slips;
    }
    plain &= held;
    stress = shared_stress(stress, add_diagonal(row[0] * away, P(0.5) * row[1] * change),
                           select<T>(relaxes, four[6], P(0)));
  }
  if (kLaws != kElasticOnly && mask_bits(loss > P(0)) != 0)
    stress = unloading_share(loss, row[kPaceColumn], stress, c) * stress;
  P slope[9];
  const P scale = P(dt_next) * row[kStressColumn];
  const Mat3<P> tau = to_mat3(stress);
  for (int i = 0; i < 9; ++i) slope[i] = row[kMassColumn] * c.m[i] - scale * tau.m[i];

  const P speed2 = value[0] * value[0] + value[1] * value[1] + value[2] * value[2];
  const auto keep = [&](P& most, Int mask, P x) {
    most = max(most, select<T>(plain & mask, x, P(0)));
  };
  keep(largest.speed2, plain, speed2);
  if (measures_waves(*s.clock, kLaws)) {
    P gradient2(0);
    for (int i = 0; i < 9; ++i) gradient2 += c.m[i] * c.m[i];
    // elastic_wave_squared
    const P n = sqrt(n2);
    const P mean = clamp(isochoric * (P(1) + trace(e) * P(1.0 / 3.0)), P(1), P(kDeviatorMax));
    const P along =
        row[0] * (P(4.0 / 3.0) * mean + P(0.272165526975909) * n) + P(0.5) * row[1] * (P(2) + j2m1);
    const P across = row[0] * (mean + P(0.816496580927726) * n);
    keep(largest.wave2, plain, max(along, across) * row[kInverseDensityColumn]);
    keep(largest.gradient2, whole, gradient2);
  }

  const uint32_t done = mask_bits(plain);
  if (done != 0) {
    counts.leaves = counts.leaves || (mask_bits(leaves) & done) != 0;
    packet.store3(rest, s.offset, done);
    if constexpr (kKeeps) {  // keep_own
      P velocity[3], own[9];
      packet.load3(s.velocity, velocity);
      packet.load9(s.own, own);
      const Mat3<P> spin = spin_beside(value, velocity, P(dt), P(inv_dx));
      for (int i = 0; i < 9; ++i) {
        own[i] += row[kMassColumn] * spin.m[i];
        slope[i] += own[i];
        own[i] += row[kMassColumn] * c.m[i];
      }
      for (int i = 0; i < 3; ++i) velocity[i] += value[i];
      packet.store3(velocity, s.velocity, done);
      packet.store9(own, s.own, done);
    } else {
      packet.store3(value, s.velocity, done);
    }
    packet.store6(e, s.strain, done);
    packet.store9(slope, s.slope, done);
    for (uint32_t left = done; left != 0; left &= left - 1) {
      const int lane = __builtin_ctz(left);
      s.meta[packet.index[lane]] = static_cast<uint32_t>(moved[lane]);
    }
    if constexpr (kLaws != kElasticOnly) {
      const uint32_t yielding = done & mask_bits(softens);
      counts.plastic += __builtin_popcount(yielding);
      for (uint32_t left = yielding; left != 0; left &= left - 1) {
        const int lane = __builtin_ctz(left);
        s.alpha[packet.index[lane]] = alpha_after[lane];
        s.peak[packet.index[lane]] = peak_after[lane];
      }
    }
    if constexpr (kLaws == kDamageField) {
      counts.plastic += __builtin_popcount(done & mask_bits(forgets));
      for (uint32_t left = done & mask_bits(phase); left != 0; left &= left - 1) {
        const int lane = __builtin_ctz(left);
        s.alpha[packet.index[lane]] = history[lane];
      }
    }
    if constexpr (with_springs(kLaws)) {
      const uint32_t kept = done & mask_bits(relaxes);
      const P first[4] = {spring.xx, spring.yy, spring.zz, spring.xy};
      const P last[4] = {spring.zz, spring.xy, spring.xz, spring.yz};
      packet.store4(first, s.viscous, kViscousColumns, 0, kept);
      packet.store4(last, s.viscous, kViscousColumns, 2, kept);
    }
    if constexpr (kTrack) {
      Mat3<P> f;
      packet.load9(s.deformation, f.m);
      f = f + P(dt) * matmul(c, f);
      packet.store9(f.m, s.deformation, done);
    }
  }
  for (uint32_t left = packet.active & ~done; left != 0; left &= left - 1) {
    const int lane = __builtin_ctz(left);
    T one[3];
    Mat3<T> moment;
    for (int i = 0; i < 3; ++i) one[i] = value[i][lane];
    for (int i = 0; i < 9; ++i) moment.m[i] = first.m[i][lane];
    counts.add(finish_particle<T, kLaws, kTrack, kKeeps>(s, packet.index[lane], reach, one, moment,
                                                         dt, dt_next, counts.largest));
  }
}

}  // namespace gsf::cpu
