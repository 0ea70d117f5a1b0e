// CPU kernel of neo_hookean_energy; called by plasticity.cpp.
#include "core/material/stored_energy.h"

namespace gsf {

template <typename T>
void stored_energies(const StoredEnergyArgs<T>& a, int64_t begin, int64_t end) {
  for (int64_t i = begin; i < end; ++i) stored_energy_particle(a, i);
}
template void stored_energies(const StoredEnergyArgs<float>&, int64_t, int64_t);
template void stored_energies(const StoredEnergyArgs<double>&, int64_t, int64_t);

}  // namespace gsf
