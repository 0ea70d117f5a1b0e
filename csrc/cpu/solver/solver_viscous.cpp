// Particles of scenes with viscous matter (core/material/viscous.h), apart from the loops over
// the others: gcc inlines by the size of a whole file, and with it would move their last bits.
#include "cpu/solver/homes.h"

namespace gsf::cpu {

template <typename T>
void prime_viscous(const SolverView<T>& s, int64_t begin, int64_t end, bool measure, T dt,
                   Largest& largest) {
  for (int64_t p = begin; p < end; ++p) prime_particle<T, kViscousAny>(s, p, measure, dt, largest);
}

template <typename T>
Counts HomePass<T>::from_nodes_viscous(int laws) const {
  return laws == kViscousBrittle ? from_nodes<kViscousBrittle>() : from_nodes<kViscousAny>();
}

template void prime_viscous(const SolverView<float>&, int64_t, int64_t, bool, float, Largest&);
template void prime_viscous(const SolverView<double>&, int64_t, int64_t, bool, double, Largest&);
template Counts HomePass<float>::from_nodes_viscous(int) const;
template Counts HomePass<double>::from_nodes_viscous(int) const;

}  // namespace gsf::cpu
