// Launches the kernels of a build of one rank; of several: cuda/ranks/build.cu.
#include "cuda/solver/build.h"

namespace gsf::cuda {

template <typename T>
cudaError_t solver_build(const SolverView<T>& s, cudaStream_t stream) {
  const unsigned table = ctas(s.table_size), homes = static_cast<unsigned>(s.home_capacity);
  clear_kernel<T><<<table, kThreads, 0, stream>>>(s);
  insert_kernel<T><<<homes, kThreads, 0, stream>>>(s);
  homes_kernel<T><<<table, kThreads, 0, stream>>>(s);
  slots_kernel<T><<<table, kThreads, 0, stream>>>(s);
  verdict_kernel<T><<<1, 1, 0, stream>>>(s);
  sites_kernel<T><<<table, kThreads, 0, stream>>>(s);
  if (s.moments != nullptr)
    edges_kernel<T><<<ctas(s.slot_capacity * kNeighbours), kThreads, 0, stream>>>(s);
  neighbours_kernel<T><<<ctas(s.home_capacity * kNeighbours), kThreads, 0, stream>>>(s);
  place_kernel<T><<<homes, kThreads, 0, stream>>>(s);
  invert_kernel<T><<<ctas(s.count), kThreads, 0, stream>>>(s);
  stripe_kernel<T><<<homes, kThreads, 0, stream>>>(s);
  for (int pass = kPlacePass; pass <= kOwnPass; ++pass) {
    if (!has_pass(s, pass)) continue;
    carry_kernel<T, false><<<ctas(s.count), kThreads, 0, stream>>>(s, pass);
    carry_kernel<T, true><<<ctas(s.count), kThreads, 0, stream>>>(s, pass);
  }
  bound_kernel<T><<<homes, kThreads, 0, stream>>>(s);
  if (s.damage_counts != nullptr) solver_damage_marks(s, stream);
  finish_kernel<T><<<1, 1, 0, stream>>>(s);
  return cudaGetLastError();
}

template cudaError_t solver_build<float>(const SolverView<float>&, cudaStream_t);
template cudaError_t solver_build<double>(const SolverView<double>&, cudaStream_t);

}  // namespace gsf::cuda
