// CUDA kernels of the MPM transfers: one thread per particle in cell order. p2g sums runs of
// particles with the same base node inside the warp first, then adds one vector per node: the L2
// rate of scattered reductions is the bound.
#include "cuda/mpm/launch.h"
#include "cuda/threads.h"

namespace gsf::cuda {
namespace {

constexpr unsigned kAll = 0xffffffffu;

template <typename T>
__device__ void add4(T* p, const T (&v)[4]) {
  for (int c = 0; c < 4; ++c) atomicAdd(p + c, v[c]);
}
template <>
__device__ void add4<float>(float* p, const float (&v)[4]) {
#if __CUDA_ARCH__ >= 900
  atomicAdd(reinterpret_cast<float4*>(p), make_float4(v[0], v[1], v[2], v[3]));
#else
  for (int c = 0; c < 4; ++c) atomicAdd(p + c, v[c]);
#endif
}
// A maximal run of neighbouring lanes that share base node and field.
struct Run {
  bool head;
  int end;    // first lane after the run
  int steps;  // power of two that covers the longest run of the warp

  __device__ Run(const int32_t* base, int32_t field, bool active) {
    const int lane = threadIdx.x & 31;
    // Every lane takes part in every shuffle; only then may the verdict differ.
    const int active_before = __shfl_up_sync(kAll, int(active), 1);
    bool same = lane > 0 && active && active_before != 0;
    const int32_t key[4] = {base[0], base[1], base[2], field};
    for (int i = 0; i < 4; ++i) {
      const int32_t before = __shfl_up_sync(kAll, key[i], 1);
      same = same && before == key[i];
    }
    head = !same;
    const unsigned heads = __ballot_sync(kAll, head);
    const unsigned later = lane == 31 ? 0u : heads & (kAll << (lane + 1));
    end = later == 0u ? 32 : __ffs(later) - 1;
    steps = __reduce_max_sync(kAll, unsigned(end - lane));
  }

  // Sum over the run, valid in its head.
  template <typename T>
  __device__ T sum(T v) const {
    const int lane = threadIdx.x & 31;
    for (int offset = 1; offset < steps; offset *= 2) {
      const T other = __shfl_down_sync(kAll, v, offset);
      if (lane + offset < end) v += other;
    }
    return v;
  }
};

__device__ void count_skipped(bool skipped, int64_t* total) {
  const unsigned mask = __ballot_sync(kAll, skipped);
  if ((threadIdx.x & 31) == 0 && mask != 0u)
    atomicAdd(reinterpret_cast<unsigned long long*>(total),
              static_cast<unsigned long long>(__popc(mask)));
}

template <typename T, bool kMoments>
__global__ void __launch_bounds__(kFewThreads) p2g_kernel(P2GArgs<T> a) {
  const int64_t r = thread_number<kFewThreads>();
  const bool exists = r < a.blocks.particles;
  int64_t p = exists ? a.blocks.order[r] : -1;
  const bool valid = p >= 0 && p < a.blocks.particles;
  if (!valid) p = 0;
  int32_t field;
  Stencil<T> s{};
  StencilBlocks at{};
  const bool active = locate_particle(a, valid, p, field, s, at);
  count_skipped(exists && !active, a.skipped);
  ParticleMomentum<T> q{};
  T mass = T(0);
  if (active) {
    const T* stress = a.stress != nullptr ? a.stress + 6 * p : nullptr;
    mass = a.mass[p];
    q = particle_momentum(s, mass, a.velocity + 3 * p, a.affine + 9 * p, stress,
                          stress != nullptr ? a.volume[p] : T(0), a.dx, a.dt);
  }
  const Run run(s.base, field, active);
  const bool writes = run.head && active;
  const int64_t base = int64_t(field) * a.blocks.count * kBlockNodes;
  // Every lane goes through every shuffle; only heads of active runs write. Not for_each_node: with
  // these shuffles in a lambda nvcc 13.0 makes the kernel longer.
#pragma unroll
  for (int i = 0; i < 3; ++i)
#pragma unroll
    for (int j = 0; j < 3; ++j)
#pragma unroll
      for (int k = 0; k < 3; ++k) {
        const T w = s.weight(i, j, k);
        T give[4];
        for (int c = 0; c < 3; ++c)
          give[c] = run.sum(w * (q.constant[c] + q.slope(c, 0) * T(i) + q.slope(c, 1) * T(j) +
                                 q.slope(c, 2) * T(k)));
        give[3] = run.sum(w * q.mass);
        const int64_t node = writes ? base + at.node(s, i, j, k) : 0;
        if (writes) add4<T>(a.grid + 4 * node, give);
        if constexpr (kMoments) {
          const Vec3<T> m = contact_moment(s, mass * w, i, j, k);
          T sum[kContactMoments];
          for (int c = 0; c < kContactMoments; ++c) sum[c] = run.sum(m[c]);
          if (writes)
            for (int c = 0; c < kContactMoments; ++c)
              atomicAdd(a.moments + kContactMoments * node + c, sum[c]);
        }
      }
}

// sum w g and sum w g (x_i - x_p)^T from kChannels values per node.
template <typename T, int kChannels>
__device__ Gathered<T> gather(const T* grid, const StencilBlocks& at, const Stencil<T>& s, T dx) {
  Gathered<T> g{};
  for_each_node([&](int i, int j, int k) {
    const T* node = grid + kChannels * at.node(s, i, j, k);
    const T w = s.weight(i, j, k);
    const T offset[3] = {T(i) - s.f[0], T(j) - s.f[1], T(k) - s.f[2]};
    for (int c = 0; c < kChannels; ++c) {
      const T v = w * node[c];
      g.value[c] += v;
      if (c < 3)
        for (int d = 0; d < 3; ++d) g.first(c, d) += v * offset[d];
    }
  });
  for (int i = 0; i < 9; ++i) g.first.m[i] *= dx;
  return g;
}

template <typename T, bool kAdjoint>
__global__ void __launch_bounds__(kFewThreads) gather_kernel(GatherArgs<T> a) {
  constexpr int kChannels = kAdjoint ? 4 : 3;
  const int64_t r = thread_number<kFewThreads>();
  const bool exists = r < a.blocks.particles;
  const int64_t p = exists ? a.blocks.order[r] : -1;
  const bool valid = p >= 0 && p < a.blocks.particles;
  int32_t field;
  Stencil<T> s{};
  StencilBlocks at{};
  const bool active = locate_particle(a, valid, p, field, s, at);
  count_skipped(exists && !active, a.skipped);
  if (!valid) return;
  Gathered<T> g{};
  if (active) {
    const T* grid = a.grid + kChannels * int64_t(field) * a.blocks.count * kBlockNodes;
    g = gather<T, kChannels>(grid, at, s, a.dx);
  }
  if constexpr (kAdjoint) {
    for (int c = 0; c < 4; ++c) a.value_out[4 * p + c] = g.value[c];
    store_mat3(a.first_out + 9 * p, g.first);
  } else {
    const T* f = a.deformation != nullptr ? a.deformation + 9 * p : nullptr;
    T* f_out = a.deformation_out != nullptr ? a.deformation_out + 9 * p : nullptr;
    if (active)
      finish_g2p(g, a.dx, a.dt, a.position + 3 * p, f, a.position_out + 3 * p,
                 a.velocity_out + 3 * p, a.affine_out + 9 * p, f_out);
    else
      skip_g2p(a.dt, a.position + 3 * p, a.velocity != nullptr ? a.velocity + 3 * p : nullptr, f,
               a.position_out + 3 * p, a.velocity_out + 3 * p, a.affine_out + 9 * p, f_out);
  }
}

__device__ double warp_sum(double v) {
  for (int offset = 16; offset > 0; offset /= 2) v += __shfl_down_sync(kAll, v, offset);
  return v;
}

// Sums kColumns numbers over the CTA into `out`, in a fixed order.
template <int kColumns>
__device__ void sum_cta(double (&value)[kColumns], double* out) {
  __shared__ double sums[kFewThreads / 32][kColumns];
  for (int i = 0; i < kColumns; ++i) value[i] = warp_sum(value[i]);
  if ((threadIdx.x & 31) == 0)
    for (int i = 0; i < kColumns; ++i) sums[threadIdx.x / 32][i] = value[i];
  __syncthreads();
  if (threadIdx.x < kColumns) {
    double s = 0.0;
    for (int w = 0; w < kFewThreads / 32; ++w) s += sums[w][threadIdx.x];
    out[threadIdx.x] = s;
  }
  __syncthreads();
}

// The nodes of one chunk, which one CTA works on.
struct Chunk {
  int64_t first, last;
  __device__ explicit Chunk(int64_t count) {
    first = int64_t(blockIdx.x) * kChunkBlocks * kBlockNodes;
    const int64_t end = first + kChunkBlocks * kBlockNodes, total = count * kBlockNodes;
    last = end < total ? end : total;
    first += threadIdx.x;
  }
};

// Velocities and contact between fields, then the mass that each collider with mass touches.
template <typename T>
__global__ void __launch_bounds__(kFewThreads) grid_velocity_kernel(GridUpdateArgs<T> a) {
  const Chunk chunk(a.count);
  unsigned touched = 0;
  for (int64_t node = chunk.first; node < chunk.last; node += kFewThreads)
    touched += update_node(a, node) ? 1u : 0u;
  if (a.moments != nullptr) {
    touched = __reduce_add_sync(kAll, touched);
    if ((threadIdx.x & 31) == 0 && touched != 0u)
      atomicAdd(reinterpret_cast<unsigned long long*>(a.contact_nodes),
                static_cast<unsigned long long>(touched));
  }
  for (int64_t c = 0; c < a.collider_count; ++c) {
    const T* row = a.colliders + c * kColliderColumns;
    double mass[1] = {0.0};
    if (row[kMass] > T(0) && collider_valid(row, a.sdf_count))
      for (int64_t node = chunk.first; node < chunk.last; node += kFewThreads)
        mass[0] += touching_mass(a, row, node);
    sum_cta(mass, a.partial + int64_t(blockIdx.x) * a.collider_count + c);
  }
}

// Every collider in row order, with an ordered partial sum of its impulse and torque.
template <typename T>
__global__ void __launch_bounds__(kFewThreads) grid_collide_kernel(GridUpdateArgs<T> a) {
  const Chunk chunk(a.count);
  for (int64_t c = 0; c < a.collider_count; ++c) {
    const T* row = a.colliders + c * kColliderColumns;
    double sums[6] = {};
    if (collider_valid(row, a.sdf_count)) {
      const T give = collider_give(row, static_cast<T>(a.contact_mass[c]));
      for (int64_t node = chunk.first; node < chunk.last; node += kFewThreads)
        collide_node(a, row, give, node, sums);
    } else {
      // A row that is no collider must not be ignored quietly.
      for (int i = 0; i < 6; ++i) sums[i] = double(NAN);
    }
    sum_cta(sums, a.partial + (int64_t(blockIdx.x) * a.collider_count + c) * 6);
  }
}

// One warp per column; lanes stride over the chunks, so the order of the sum is fixed.
__global__ void sum_chunks_kernel(const double* partial, int64_t chunks, int64_t columns,
                                  double* sums) {
  const int64_t column = blockIdx.x;
  double s = 0.0;
  for (int64_t chunk = threadIdx.x; chunk < chunks; chunk += 32)
    s += partial[chunk * columns + column];
  s = warp_sum(s);
  if (threadIdx.x == 0) sums[column] = s;
}

}  // namespace

template <typename T>
cudaError_t p2g(const P2GArgs<T>& a, cudaStream_t stream) {
  if (a.blocks.particles == 0) return cudaSuccess;
  if (a.moments != nullptr)
    p2g_kernel<T, true><<<blocks_for<kFewThreads>(a.blocks.particles), kFewThreads, 0, stream>>>(a);
  else
    p2g_kernel<T, false>
        <<<blocks_for<kFewThreads>(a.blocks.particles), kFewThreads, 0, stream>>>(a);
  return cudaGetLastError();
}

template <typename T>
cudaError_t g2p(const GatherArgs<T>& a, cudaStream_t stream) {
  if (a.blocks.particles == 0) return cudaSuccess;
  gather_kernel<T, false>
      <<<blocks_for<kFewThreads>(a.blocks.particles), kFewThreads, 0, stream>>>(a);
  return cudaGetLastError();
}

template <typename T>
cudaError_t p2g_adjoint(const GatherArgs<T>& a, cudaStream_t stream) {
  if (a.blocks.particles == 0) return cudaSuccess;
  gather_kernel<T, true>
      <<<blocks_for<kFewThreads>(a.blocks.particles), kFewThreads, 0, stream>>>(a);
  return cudaGetLastError();
}

template <typename T>
cudaError_t grid_update(const GridUpdateArgs<T>& a, cudaStream_t stream) {
  const int64_t chunks = grid_update_chunks(a.count), rows = a.collider_count;
  if (chunks == 0) return cudaSuccess;
  grid_velocity_kernel<T><<<chunks, kFewThreads, 0, stream>>>(a);
  if (rows > 0) {
    sum_chunks_kernel<<<rows, 32, 0, stream>>>(a.partial, chunks, rows, a.contact_mass);
    grid_collide_kernel<T><<<chunks, kFewThreads, 0, stream>>>(a);
    sum_chunks_kernel<<<6 * rows, 32, 0, stream>>>(a.partial, chunks, 6 * rows, a.impulse);
  }
  return cudaGetLastError();
}

#define GSF_INSTANTIATE(T)                                                 \
  template cudaError_t p2g<T>(const P2GArgs<T>&, cudaStream_t);            \
  template cudaError_t g2p<T>(const GatherArgs<T>&, cudaStream_t);         \
  template cudaError_t p2g_adjoint<T>(const GatherArgs<T>&, cudaStream_t); \
  template cudaError_t grid_update<T>(const GridUpdateArgs<T>&, cudaStream_t);
GSF_INSTANTIATE(float)
GSF_INSTANTIATE(double)
#undef GSF_INSTANTIATE

}  // namespace gsf::cuda
