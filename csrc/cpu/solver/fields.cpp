// The resident solver on the CPU with phase-field matter: cpu/solver/damage.h and the update of its
// particles.
#include "cpu/solver/damage.h"

namespace gsf::cpu {

template <typename T>
FieldPass<T>::FieldPass(const SolverView<T>& s) : damage_(std::make_unique<DamagePass<T>>(s)) {}
template <typename T>
FieldPass<T>::~FieldPass() = default;

template <typename T>
void FieldPass<T>::plan() {
  damage_->plan();
}

template <typename T>
Counts FieldPass<T>::from_nodes(const HomePass<T>& homes) {
  damage_->run();
  return homes.template from_nodes<kDamageField>();
}

template <typename T>
void FieldPass<T>::prime(const SolverView<T>& s, int64_t begin, int64_t end, bool measure, T dt,
                         Largest& largest) {
  for (int64_t p = begin; p < end; ++p) prime_particle<T, kDamageField>(s, p, measure, dt, largest);
}

template class FieldPass<float>;
template class FieldPass<double>;

}  // namespace gsf::cpu
