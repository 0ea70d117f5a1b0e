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
  damage_->run(homes);
  return homes.template from_nodes<kDamageField>();
}

template <typename T>
Counts FieldPass<T>::prime(const SolverView<T>& s, bool measure) {
  const T dt = static_cast<T>(s.clock->dt);
  constexpr int64_t kGrain = 2048;
  return parallel_counts(s.count, kGrain, [&](int64_t begin, int64_t end, Counts& counts) {
    for (int64_t p = begin; p < end; ++p)
      prime_particle<T, kDamageField>(s, p, measure, dt, counts.largest);
  });
}

template class FieldPass<float>;
template class FieldPass<double>;

}  // namespace gsf::cpu
