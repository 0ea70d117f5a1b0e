// One particle of the return_mapping op: looks up its material row, steps, stores. The body of both
// the CPU loop and the CUDA kernel.
#pragma once

#include "core/material_args.h"
#include "core/nacc.h"

namespace gsf {

inline constexpr int kParamColumns = 8;

// Columns of a params row: mu, kappa, M, beta, xi, eta, density (not used here), reserved.
template <typename T>
GSF_HOST_DEVICE NaccMaterial<T> load_material(const T* row) {
  return {row[0], row[1], row[2], row[3], row[4], row[5]};
}

struct ReturnFlags {
  bool plastic, guarded, inverted, invalid;
};

// A row or law that does not exist counts the particle as invalid and leaves it stress-free;
// nothing is read outside the tables.
template <typename T>
GSF_HOST_DEVICE ReturnFlags return_mapping_particle(const ReturnMappingArgs<T>& a, int64_t i) {
  const int64_t row = a.material != nullptr ? a.material[i] : (a.rows == 1 ? 0 : i);
  const bool known = row >= 0 && row < a.rows;
  const int law = known ? a.law[row] : -1;
  ReturnMapped<T> r;
  if (law == 0 || law == 1) {
    const NaccOptions<T> options{a.k, a.epsilon, a.implicit_alpha};
    r = return_mapping(load_sym3(a.strain + 6 * i), a.alpha[i], load_mat3(a.increment + 9 * i), law,
                       load_material(a.params + kParamColumns * row), options);
  } else {
    r.strain = r.stress = {T(0), T(0), T(0), T(0), T(0), T(0)};
    r.alpha = a.alpha[i];
    r.plastic = r.guarded = r.inverted = false;
    r.invalid = true;
  }
  store_sym3(a.strain_out + 6 * i, r.strain);
  store_sym3(a.stress_out + 6 * i, r.stress);
  a.alpha_out[i] = r.alpha;
  return {r.plastic, r.guarded, r.inverted, r.invalid};
}

}  // namespace gsf
