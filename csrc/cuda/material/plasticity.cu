// CUDA kernels of return_mapping and neo_hookean_energy: one thread per particle; the counters of
// return_mapping are reduced per block first.
#include "core/material/more_laws.h"
#include "core/material/stored_energy.h"
#include "cuda/material/launch.h"
#include "cuda/threads.h"

namespace gsf::cuda {
namespace {

// kMore: for laws of more_laws.h, too.
template <typename T, bool kMore>
__global__ void __launch_bounds__(kFewThreads) return_mapping_kernel(const ReturnMappingArgs<T> a) {
  const int64_t i = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  ReturnFlags f{false, false, false, false};
  if (i < a.count) {
    if constexpr (kMore)
      f = return_mapping_particle_more(a, i);
    else
      f = return_mapping_particle(a, i);
  }
  // Every thread of the block reaches the barriers below, also those past the end.
  const int plastic = __syncthreads_count(f.plastic);
  const int guarded = __syncthreads_count(f.guarded);
  const int inverted = __syncthreads_count(f.inverted);
  const int invalid = __syncthreads_count(f.invalid);
  if (threadIdx.x == 0) {
    if (plastic) atomicAdd(a.info + 0, plastic);
    if (guarded) atomicAdd(a.info + 1, guarded);
    if (inverted) atomicAdd(a.info + 2, inverted);
    if (invalid) atomicAdd(a.info + 3, invalid);
  }
}

template <typename T>
__global__ void __launch_bounds__(kFewThreads) stored_energy_kernel(const StoredEnergyArgs<T> a) {
  const int64_t i = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i < a.count) stored_energy_particle(a, i);
}

}  // namespace

template <typename T>
cudaError_t return_mapping(const ReturnMappingArgs<T>& args, cudaStream_t stream) {
  if (args.count == 0) return cudaSuccess;
  const unsigned blocks = blocks_for<kFewThreads>(args.count);
  if (args.apart)
    return_mapping_kernel<T, true><<<blocks, kFewThreads, 0, stream>>>(args);
  else
    return_mapping_kernel<T, false><<<blocks, kFewThreads, 0, stream>>>(args);
  return cudaGetLastError();
}

template cudaError_t return_mapping(const ReturnMappingArgs<float>&, cudaStream_t);
template cudaError_t return_mapping(const ReturnMappingArgs<double>&, cudaStream_t);

template <typename T>
cudaError_t neo_hookean_energy(const StoredEnergyArgs<T>& args, cudaStream_t stream) {
  if (args.count == 0) return cudaSuccess;
  const unsigned blocks = blocks_for<kFewThreads>(args.count);
  stored_energy_kernel<T><<<blocks, kFewThreads, 0, stream>>>(args);
  return cudaGetLastError();
}

template cudaError_t neo_hookean_energy(const StoredEnergyArgs<float>&, cudaStream_t);
template cudaError_t neo_hookean_energy(const StoredEnergyArgs<double>&, cudaStream_t);

}  // namespace gsf::cuda
