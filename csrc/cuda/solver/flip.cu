// Points of the resident solver that keep a share of their own motion (FLIP beside APIC): before a
// step they go to the nodes with nothing that acts on them, and g2p takes back what of that comes
// back. A file of its own, so that the kernels of other scenes stay as they are compiled. On the
// CPU: cpu/mpm/flip.h.
#include "cuda/solver/g2p.h"

namespace gsf::cuda {
namespace {

// As p2g_kernel, of velocity and `own`: no stress, no pushes, each field for itself.
template <typename T>
__global__ void __launch_bounds__(kP2GThreads, kP2GCtas)
    free_p2g_kernel(const __grid_constant__ SolverView<T> s, int split_shift) {
  const SolverClock& clock = *s.clock;
  const int64_t home = clock.homes - 1 - (blockIdx.x >> split_shift);
  if (!may_step(clock) || home < 0) return;
  p2g_home<T, false, true>(s, home, blockIdx.x & ((1 << split_shift) - 1), split_shift);
}

// Their velocities; the sums are cleared for those of the step.
template <typename T>
__global__ void __launch_bounds__(kSolverThreads)
    free_grid_kernel(const __grid_constant__ SolverView<T> s) {
  const SolverClock& clock = *s.clock;
  if (!may_step(clock)) return;
  for (int64_t i = int64_t(blockIdx.x) * kSolverThreads + threadIdx.x;
       i < clock.slots * kBlockNodes; i += int64_t(gridDim.x) * kSolverThreads) {
    const int64_t node = held_slot(s, i / kBlockNodes) * kBlockNodes + i % kBlockNodes;
    const NodeSums<T> sums = read_sums(s, node);
    clear_sums(s, node, 0);
    Vec3<T> v;
    node_velocity(s, sums, T(0), v);
    store_velocity(s.free_velocity, node, v);
  }
}

}  // namespace

template <typename T>
void solver_free_to_nodes(const SolverView<T>& s, cudaStream_t stream) {
  const int shift = split_shift(s);
  const unsigned homes = static_cast<unsigned>(s.home_capacity);
  free_p2g_kernel<T><<<homes << shift, kP2GThreads, 0, stream>>>(s, shift);
}
template <typename T>
void solver_free_nodes(const SolverView<T>& s, cudaStream_t stream) {
  const unsigned ctas = slot_ctas(s, kSolverThreads / kBlockNodes);
  free_grid_kernel<T><<<ctas, kSolverThreads, 0, stream>>>(s);
}

template <typename T>
void solver_keep(const SolverView<T>& s, int law_set, cudaStream_t stream) {
  if (law_set == kElasticOnly)
    launch_g2p<T, kElasticOnly, true>(s, stream);
  else if (law_set == kBrittle)
    launch_g2p<T, kBrittle, true>(s, stream);
  else if (with_springs(law_set))
    launch_g2p<T, kViscousAny, true>(s, stream);
  else if (law_set == kMoreLaws)
    launch_g2p<T, kMoreLaws, true>(s, stream);
  else
    launch_g2p<T, kAnyLaw, true>(s, stream);
}

#define GSF_INSTANTIATE(T)                                                   \
  template void solver_free_to_nodes<T>(const SolverView<T>&, cudaStream_t); \
  template void solver_free_nodes<T>(const SolverView<T>&, cudaStream_t);    \
  template void solver_keep<T>(const SolverView<T>&, int, cudaStream_t);
GSF_INSTANTIATE(float)
GSF_INSTANTIATE(double)
#undef GSF_INSTANTIATE

}  // namespace gsf::cuda
