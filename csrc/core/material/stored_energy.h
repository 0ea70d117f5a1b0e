// Stored elastic energy of one particle, neo-Hookean whatever its law.
#pragma once

#include <limits>

#include "core/material/args.h"
#include "core/material/elastic.h"
#include "core/material/return_mapping.h"

namespace gsf {

template <typename T>
GSF_HOST_DEVICE void stored_energy_particle(const StoredEnergyArgs<T>& a, int64_t i) {
  const int64_t row = a.material != nullptr ? a.material[i] : (a.rows == 1 ? 0 : i);
  if (row < 0 || row >= a.rows) {
    a.energy[i] = std::numeric_limits<T>::quiet_NaN();
    return;
  }
  const MaterialRow<T> m = load_material(a.params + kParamColumns * row);
  a.energy[i] = unguarded_energy(m.mu, m.kappa, load_sym3(a.strain + 6 * i));
}

}  // namespace gsf
