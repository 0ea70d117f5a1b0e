// One step of the resident solver on the GPU: p2g, the nodes and g2p (headers).
#include "cuda/solver/g2p.h"

namespace gsf::cuda {
namespace {

constexpr int kThreads = kSolverThreads;
// Once the largest values of all points are known.
template <typename T>
__device__ void start(const SolverView<T>& s, bool measure) {
  if (measure)
    start_clock(*s.clock, double(s.dx));
  else
    choose_unit(*s.clock);
}
template <typename T, int kLaws>
__global__ void __launch_bounds__(kThreads)
    prime_kernel(const __grid_constant__ SolverView<T> s, bool measure) {
  const SolverClock& clock = *s.clock;
  if (clock.grow != 0 || int64_t(blockIdx.x) >= clock.homes) return;
  __shared__ CtaEnd<4> end;
  end.clear();
  __syncthreads();
  const HomeList<T>& homes = s.homes();
  const int64_t first = homes.start[blockIdx.x], count = homes.count[blockIdx.x];
  const int64_t home_total = clock.homes;
  const T dt = T(clock.dt);
  Largest largest{};
  for (int64_t r = threadIdx.x; r < count; r += kThreads)
    if (first + r >= 0 && first + r < s.count)
      prime_particle<T, kLaws>(s, first + r, measure, dt, largest);
  __syncwarp();
  const float values[4] = {largest.speed2, largest.wave2, largest.gradient2, largest.bound};
  unsigned bits[4];
  if (!end.leave(values, bits)) return;
  hand_over(s, bits, measure ? -1 : int64_t(blockIdx.x), measure);
  if (!last_to_arrive(&s.clock->arrived, home_total) || (threadIdx.x & 31) != 0) return;
  if (s.peers == nullptr) start(s, measure);
}

// Of several ranks: the maxima and sums of all are this one's, and the step ends. One warp; a
// second CTA does the same for the view of all.
template <typename T>
__global__ void end_kernel(const __grid_constant__ SolverView<T> own) {
  const SolverView<T>& s = blockIdx.x == 0 ? own : own.peers[own.ranks];
  SolverClock& clock = *s.clock;
  if (!may_step(clock)) return;
  __shared__ int64_t all[kMailWords];
  const int64_t words = kMailWords + s.collider_count * kImpulseSums;
  for (int64_t i = threadIdx.x; i < words; i += 32) {
    int64_t most = 0, sum = 0;
    for (int q = 0; q < s.ranks; ++q) {
      const int64_t told = s.peers[q].mail[i];
      most = max(most, told);
      sum += told;
    }
    if (i < kMailWords)
      all[i] = i <= kMailBound ? most : sum;
    else
      s.impulse_units[i - kMailWords] = sum;
  }
  __syncwarp();
  if (threadIdx.x == 0) {
    clock.speed = static_cast<uint64_t>(all[kMailSpeed]);
    clock.wave = static_cast<uint64_t>(all[kMailWave]);
    clock.gradient = static_cast<uint64_t>(all[kMailGradient]);
    clock.bound = static_cast<uint64_t>(all[kMailBound]);
    if (s.rank == s.ranks) {  // the clock of all counts; those of the ranks have told
      clock.plastic += all[kMailPlastic];
      clock.guarded += all[kMailGuarded];
      clock.inverted += all[kMailInverted];
      clock.invalid += all[kMailInvalid];
    }
    clock.touched = all[kMailTouched];
    clock.lost = all[kMailLost];
    clock.leaving = all[kMailLeaving];
  }
  __threadfence();
  __syncwarp();
  end_of_step(s);
}

// The same for the largest values before the first step.
template <typename T>
__global__ void tell_start_kernel(const __grid_constant__ SolverView<T> s) {
  const SolverClock& c = *s.clock;
  const uint64_t largest[] = {c.speed, c.wave, c.gradient, c.bound};
  for (int i = kMailSpeed; i <= kMailBound; ++i) s.mail[i] = static_cast<int64_t>(largest[i]);
}
template <typename T>
__global__ void start_kernel(const __grid_constant__ SolverView<T> s, bool measure) {
  SolverClock& c = *s.clock;
  if (c.grow != 0) return;  // a rank had no room for its points
  uint64_t* largest[] = {&c.speed, &c.wave, &c.gradient, &c.bound};
  for (int i = kMailSpeed; i <= kMailBound; ++i)
    for (int q = 0; q < s.ranks; ++q)
      *largest[i] = max(*largest[i], static_cast<uint64_t>(s.peers[q].mail[i]));
  start(s, measure);
}

}  // namespace

template <typename T>
void solver_prime_points(const SolverView<T>& s, int law_set, bool measure, cudaStream_t stream) {
  const unsigned homes = static_cast<unsigned>(s.home_capacity);
  if (measure && s.radius != nullptr) solver_spring_rows(s, stream);
  if (with_springs(law_set))
    prime_kernel<T, kViscousAny><<<homes, kThreads, 0, stream>>>(s, measure);
  else if (law_set == kMoreLaws)
    prime_kernel<T, kMoreLaws><<<homes, kThreads, 0, stream>>>(s, measure);
  else if (with_damage(law_set))
    prime_kernel<T, kDamageField><<<homes, kThreads, 0, stream>>>(s, measure);
  else
    prime_kernel<T, kAnyLaw><<<homes, kThreads, 0, stream>>>(s, measure);
  if (s.peers != nullptr) tell_start_kernel<T><<<1, 1, 0, stream>>>(s);
}

template <typename T>
void solver_start(const SolverView<T>& s, bool measure, cudaStream_t stream) {
  start_kernel<T><<<1, 1, 0, stream>>>(s, measure);
}

template <typename T>
cudaError_t solver_prime(const SolverView<T>& s, int law_set, cudaStream_t stream) {
  for (const bool measure : {true, false}) solver_prime_points(s, law_set, measure, stream);
  return cudaGetLastError();
}

template <typename T>
void solver_to_nodes(const SolverView<T>& s, cudaStream_t stream) {
  const int shift = split_shift(s);
  const unsigned ctas = static_cast<unsigned>(s.home_capacity) << shift;
  p2g_kernel<T><<<ctas, kP2GThreads, 0, stream>>>(s, shift);
  if (s.moments != nullptr)
    p2g_shared_kernel<T><<<min(ctas, kSharedCtas), kP2GThreads, 0, stream>>>(s, shift);
}

template <typename T>
void solver_from_nodes(const SolverView<T>& s, int law_set, cudaStream_t stream) {
  if (s.radius != nullptr)
    launch_nodes<T, true>(s, stream);
  else
    launch_nodes<T, false>(s, stream);
  if (s.own != nullptr)
    solver_keep(s, law_set, stream);
  else if (law_set == kElasticOnly)
    launch_g2p<T, kElasticOnly, false>(s, stream);
  else if (law_set == kBrittle)
    launch_g2p<T, kBrittle, false>(s, stream);
  else if (law_set == kViscousBrittle)
    launch_g2p<T, kViscousBrittle, false>(s, stream);
  else if (law_set == kViscousAny)
    launch_g2p<T, kViscousAny, false>(s, stream);
  else if (law_set == kMoreLaws)
    launch_g2p<T, kMoreLaws, false>(s, stream);
  else if (with_damage(law_set))
    solver_damage_end(s, law_set == kDamageField, stream);
  else
    launch_g2p<T, kAnyLaw, false>(s, stream);
}

template <typename T>
void solver_end(const SolverView<T>& s, bool with_all, cudaStream_t stream) {
  end_kernel<T><<<with_all ? 2 : 1, 32, 0, stream>>>(s);
}

template <typename T>
cudaError_t solver_step(const SolverView<T>& s, int law_set, cudaStream_t stream) {
  if (s.own != nullptr) {
    solver_free_to_nodes(s, stream);
    solver_free_nodes(s, stream);
  } else if (law_set == kDamageField) {
    solver_damage_begin(s, stream);
  }
  for (int part = 0; part < points_parts(s); ++part) solver_points(s, part, stream);
  solver_to_nodes(s, stream);
  solver_from_nodes(s, law_set, stream);
  return cudaGetLastError();
}

#define GSF_INSTANTIATE(T)                                                             \
  template void solver_prime_points<T>(const SolverView<T>&, int, bool, cudaStream_t); \
  template void solver_start<T>(const SolverView<T>&, bool, cudaStream_t);             \
  template cudaError_t solver_prime<T>(const SolverView<T>&, int, cudaStream_t);       \
  template void solver_to_nodes<T>(const SolverView<T>&, cudaStream_t);                \
  template void solver_from_nodes<T>(const SolverView<T>&, int, cudaStream_t);         \
  template void solver_end<T>(const SolverView<T>&, bool, cudaStream_t);               \
  template cudaError_t solver_step<T>(const SolverView<T>&, int, cudaStream_t);
GSF_INSTANTIATE(float)
GSF_INSTANTIATE(double)
#undef GSF_INSTANTIATE

}  // namespace gsf::cuda
