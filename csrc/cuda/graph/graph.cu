// CUDA kernels of the ops on graphs: one thread for a link or a point.
#include "cuda/graph/launch.h"
#include "cuda/threads.h"

namespace gsf::cuda {
namespace {

constexpr int kSweeps = 4;  // between two looks of the host; one too many changes nothing

__global__ void link_costs_kernel(LinkCostsArgs a) {
  const int64_t l = thread_number();
  int64_t one, two;
  if (l < a.links.count && link_cost(a, l, &one, &two)) a.torn_end[one] = a.torn_end[two] = true;
}

__global__ void alone_kernel(ComponentsArgs a) {
  const int64_t i = thread_number();
  if (i < a.links.points) a.root[i] = i;
}

// The root of a point; the way there is halved. Roots only ever become smaller, so a stale one
// costs a step and no more.
__device__ int64_t find(volatile int64_t* root, int64_t i) {
  int64_t up = root[i];
  while (up != i) {
    const int64_t next = root[up];
    if (next < up) root[i] = next;
    i = up;
    up = next;
  }
  return i;
}

// After Jaiganesh and Burtscher 2018: the larger of two roots is hooked onto the smaller one, and
// whoever finds it hooked already goes on from where.
__global__ void hook_kernel(ComponentsArgs a) {
  const int64_t l = thread_number();
  int64_t one, two;
  if (l >= a.links.count || !a.joins(l, &one, &two)) return;
  one = find(a.root, one);
  two = find(a.root, two);
  while (one != two) {
    const int64_t high = one > two ? one : two, low = one > two ? two : one;
    const int64_t held = static_cast<int64_t>(
        atomicCAS(reinterpret_cast<unsigned long long*>(a.root + high),
                  static_cast<unsigned long long>(high), static_cast<unsigned long long>(low)));
    if (held == high) return;
    one = find(a.root, held);
    two = find(a.root, low);
  }
}

// No way is halved here: what one thread has settled another would overwrite.
__global__ void flatten_kernel(ComponentsArgs a) {
  const int64_t i = thread_number();
  if (i >= a.links.points) return;
  const volatile int64_t* root = a.root;
  int64_t up = root[i];
  while (root[up] != up) up = root[up];
  a.root[i] = up;
}

__global__ void leading_kernel(NearestSeedsArgs a) {
  const int64_t l = thread_number();
  int64_t one, two;
  const bool leads = l < a.links.count && a.leads(l, &one, &two);
  const unsigned all = __ballot_sync(~0u, leads);
  const int lane = threadIdx.x % 32;
  unsigned long long first = 0;
  if (lane == 0 && all)
    first = atomicAdd(reinterpret_cast<unsigned long long*>(a.leading + a.links.count),
                      static_cast<unsigned long long>(__popc(all)));
  first = __shfl_sync(~0u, first, 0);
  // in no order: sweeps end at the same keys
  if (leads) a.leading[first + __popc(all & ((1u << lane) - 1))] = l;
}

__global__ void relax_kernel(NearestSeedsArgs a, int64_t leading) {
  const int64_t k = thread_number();
  if (k >= leading) return;
  const int64_t l = a.leading[k];
  int64_t one, two;
  a.links.ends(l, &one, &two);
  const volatile int64_t* key = a.key;
  const int64_t first = key[one], second = key[two];
  const int64_t there = a.offer(l, first, two, second), back = a.offer(l, second, one, first);
  if (there < second) atomicMin(reinterpret_cast<long long*>(a.key + two), there);
  if (back < first) atomicMin(reinterpret_cast<long long*>(a.key + one), back);
  if (there < second || back < first) a.leading[a.links.count + 1] = 1;
}

}  // namespace

cudaError_t link_costs(const LinkCostsArgs& a, cudaStream_t stream) {
  if (a.links.count) link_costs_kernel<<<blocks_for(a.links.count), kThreads, 0, stream>>>(a);
  return cudaGetLastError();
}

cudaError_t components(const ComponentsArgs& a, cudaStream_t stream) {
  if (a.links.points == 0) return cudaSuccess;
  alone_kernel<<<blocks_for(a.links.points), kThreads, 0, stream>>>(a);
  if (a.links.count) hook_kernel<<<blocks_for(a.links.count), kThreads, 0, stream>>>(a);
  flatten_kernel<<<blocks_for(a.links.points), kThreads, 0, stream>>>(a);
  return cudaGetLastError();
}

cudaError_t nearest_seeds(const NearestSeedsArgs& a, cudaStream_t stream) {
  if (a.links.count == 0) return cudaSuccess;
  int64_t* told = a.leading + a.links.count;
  int64_t leading = 0, changed = 0;
  cudaMemsetAsync(told, 0, 2 * sizeof(int64_t), stream);
  leading_kernel<<<blocks_for(a.links.count), kThreads, 0, stream>>>(a);
  cudaMemcpyAsync(&leading, told, sizeof(int64_t), cudaMemcpyDeviceToHost, stream);
  cudaError_t error = cudaStreamSynchronize(stream);
  if (error != cudaSuccess || leading == 0) return error;
  do {
    cudaMemsetAsync(told + 1, 0, sizeof(int64_t), stream);
    for (int sweep = 0; sweep < kSweeps; ++sweep)
      relax_kernel<<<blocks_for(leading), kThreads, 0, stream>>>(a, leading);
    cudaMemcpyAsync(&changed, told + 1, sizeof(int64_t), cudaMemcpyDeviceToHost, stream);
    error = cudaStreamSynchronize(stream);
  } while (error == cudaSuccess && changed);
  return error == cudaSuccess ? cudaGetLastError() : error;
}

}  // namespace gsf::cuda
