// One step of the resident solver on the GPU: p2g, the nodes and g2p (headers).
#include "cuda/solver/g2p.h"

namespace gsf::cuda {
namespace {

constexpr int kThreads = kSolverThreads;
template <typename T, int kLaws>
__global__ void __launch_bounds__(kThreads)
    prime_kernel(const __grid_constant__ SolverView<T> s, bool measure) {
  const SolverClock& clock = *s.clock;
  if (int64_t(blockIdx.x) >= clock.homes) return;
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
  if (measure)
    start_clock(*s.clock, double(s.dx));
  else
    choose_unit(*s.clock);
}

}  // namespace

template <typename T>
cudaError_t solver_prime(const SolverView<T>& s, int law_set, cudaStream_t stream) {
  const unsigned homes = static_cast<unsigned>(s.home_capacity);
  if (s.radius != nullptr) solver_spring_rows(s, stream);
  for (const bool measure : {true, false})
    if (with_springs(law_set))
      prime_kernel<T, kViscousAny><<<homes, kThreads, 0, stream>>>(s, measure);
    else if (law_set == kMoreLaws)
      prime_kernel<T, kMoreLaws><<<homes, kThreads, 0, stream>>>(s, measure);
    else
      prime_kernel<T, kAnyLaw><<<homes, kThreads, 0, stream>>>(s, measure);
  return cudaGetLastError();
}

template <typename T>
cudaError_t solver_step(const SolverView<T>& s, int law_set, cudaStream_t stream) {
  const unsigned homes = static_cast<unsigned>(s.home_capacity);
  const int shift = split_shift(s);
  const unsigned ctas = homes << shift;
  if (s.own != nullptr) solver_free(s, stream);
  if (s.radius != nullptr) solver_points(s, stream);
  p2g_kernel<T><<<ctas, kP2GThreads, 0, stream>>>(s, shift);
  if (s.moments != nullptr)
    p2g_shared_kernel<T><<<min(ctas, kSharedCtas), kP2GThreads, 0, stream>>>(s, shift);
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
  else
    launch_g2p<T, kAnyLaw, false>(s, stream);
  return cudaGetLastError();
}

#define GSF_INSTANTIATE(T)                                                       \
  template cudaError_t solver_prime<T>(const SolverView<T>&, int, cudaStream_t); \
  template cudaError_t solver_step<T>(const SolverView<T>&, int, cudaStream_t);
GSF_INSTANTIATE(float)
GSF_INSTANTIATE(double)
#undef GSF_INSTANTIATE

}  // namespace gsf::cuda
