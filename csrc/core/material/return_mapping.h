// The constitutive step of one particle: one dispatch over the laws, shared by the op, the resident
// solver and both back ends.
#pragma once

#include "core/material/args.h"
#include "core/material/laws.h"
#include "core/material/phase_field.h"
#include "core/material/rankine.h"
#include "core/material/wave_speed.h"

namespace gsf {

inline constexpr int kParamColumns = 8;

template <typename T>
GSF_HOST_DEVICE MaterialRow<T> load_material(const T* row) {
  return {row[0], row[1], row[2], row[3], row[4], row[5], row[6], row[7]};
}

template <typename T>
struct ReturnMapped {
  Sym3<T> strain;  // returned elastic strain b' - I
  Sym3<T> stress;  // Kirchhoff stress of the returned state [Pa]
  T alpha;
  bool plastic, guarded, inverted, invalid;
};

// One constitutive step: strain pushed forward by A = dt grad v, then returned to the surface.
// An unknown law or a state that is not finite becomes stress-free and counts as invalid.
// kWithField: whether phase_field is among the laws (not in the resident solver on CUDA).
template <bool kWithField = true, typename T>
GSF_HOST_DEVICE ReturnMapped<T> return_mapping(const Sym3<T>& strain, T alpha,
                                               const Mat3<T>& increment, int law,
                                               const MaterialRow<T>& m, const NaccOptions<T>& o,
                                               T dt) {
  using std::log1p;
  const Sym3<T> zero = {T(0), T(0), T(0), T(0), T(0), T(0)};
  ReturnMapped<T> out{zero, zero, alpha, false, false, false, false};
  const Sym3<T> e = update_strain(strain, increment);
  if (!finite(e) || !finite(alpha) || !is_law(law) || (!kWithField && law == kPhaseField)) {
    // A lost state becomes stress-free debris: it must not reach its neighbours through the grid.
    out.alpha = finite(alpha) ? alpha : T(0);
    out.invalid = true;
    return out;
  }
  if (law == kRigid) return out;
  out.inverted = !(det_identity_plus(increment) > T(0));
  if (law == kElastic || law == kNacc) {
    const ElasticState<T> s = elastic_state(e, out.inverted);
    out.guarded = s.guarded;
    NaccState<T> r{s.d, s.j2m1, alpha, false};
    if (law == kNacc) {
      const NaccMaterial<T> nacc{m.mu, m.kappa, m.strength, m.cohesion, m.hardening, m.damage};
      r = brittle_return(nacc, o, s, alpha);
    }
    out.alpha = r.alpha;
    out.plastic = r.plastic;
    // An elastic state keeps its strain bit for bit; only changed states are rebuilt.
    out.strain = s.e;
    if (r.plastic || s.guarded) out.strain = strain_from_isochoric(r.d, T(0.5) * log1p(r.j2m1));
    out.stress = kirchhoff_stress(m.mu, m.kappa, r.d, r.j2m1);
    return out;
  }
  LawResult<T> r;
  if (law == kDruckerPrager)
    r = drucker_prager(m, e, alpha, out.inverted);
  else if (kWithField && law == kPhaseField)
    r = phase_field(m, e, alpha, out.inverted);
  else if (law == kVonMises)
    r = von_mises(m, e, alpha, out.inverted);
  else if (law == kFluid)
    r = fluid(m, strain, alpha, increment, dt);
  else
    r = corotated(m, e, alpha, out.inverted);
  out.strain = r.strain;
  out.stress = r.stress;
  out.alpha = r.alpha;
  out.plastic = r.plastic;
  out.guarded = r.guarded;
  return out;
}

template <typename T>
GSF_HOST_DEVICE_COLD ReturnMapped<T> return_mapping_field(Sym3<T> strain, T alpha,
                                                          Mat3<T> increment, int law,
                                                          MaterialRow<T> m, NaccOptions<T> o,
                                                          T dt) {
  return return_mapping<true>(strain, alpha, increment, law, m, o, dt);
}
// The same where most points are of phase_field and little strained: those are done here.
template <typename T>
GSF_HOST_DEVICE ReturnMapped<T> field_mapping(const Sym3<T>& strain, T alpha,
                                              const Mat3<T>& increment, int law,
                                              const MaterialRow<T>& m, const NaccOptions<T>& o,
                                              T dt) {
  if (law == kPhaseField && !is_principal(m)) {
    const Sym3<T> e = update_strain(strain, increment);
    ReturnMapped<T> out{e, e, alpha, false, false, false, false};
    if (finite(e) && finite(alpha) && det_identity_plus(increment) > T(0) &&
        phase_field_small(m, e, out.stress, out.alpha))
      return out;
  }
  return return_mapping_field(strain, alpha, increment, law, m, o, dt);
}

struct ReturnFlags {
  bool plastic, guarded, inverted, invalid;
};

// One particle of the return_mapping op. A row or law that does not exist counts the particle as
// invalid and leaves it stress-free; nothing is read outside the tables.
template <bool kWithField = true, typename T>
GSF_HOST_DEVICE ReturnFlags return_mapping_particle(const ReturnMappingArgs<T>& a, int64_t i) {
  const int64_t row = a.material != nullptr ? a.material[i] : (a.rows == 1 ? 0 : i);
  const bool known = row >= 0 && row < a.rows;
  MaterialRow<T> material{};
  if (known) material = load_material(a.params + kParamColumns * row);
  const NaccOptions<T> options{a.k, a.epsilon, a.implicit_alpha};
  const ReturnMapped<T> r = return_mapping<kWithField>(
      load_sym3(a.strain + 6 * i), a.alpha[i], load_mat3(a.increment + 9 * i),
      known ? a.law[row] : -1, material, options, a.dt);
  store_sym3(a.strain_out + 6 * i, r.strain);
  store_sym3(a.stress_out + 6 * i, r.stress);
  a.alpha_out[i] = r.alpha;
  return {r.plastic, r.guarded, r.inverted, r.invalid};
}

}  // namespace gsf
