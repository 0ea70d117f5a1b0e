// Projection on CUDA: one thread per splat. Coefficients of spherical harmonics are most of the
// traffic (192 of 236 bytes at degree 3): a warp loads those of its 32 Gaussians together.
#include "cuda/raster/launch.h"
#include "cuda/raster/layout.h"
#include "cuda/raster/rows.h"

namespace gsf::cuda {
namespace {

template <typename T, int kDegree>
__global__ void __launch_bounds__(kRowThreads) project_kernel(RasterArgs<T> a, RasterOrder o) {
  const int64_t i = int64_t(blockIdx.x) * kRowThreads + threadIdx.x;
  const int64_t m = int64_t(blockIdx.y) * a.count + i;
  const SplatCamera<T> camera = raster_camera(a, blockIdx.y);
  Splat<T> s{};
  bool seen = i < a.count && project_geometry(a, camera, i, m, &s);
  const T* sh = a.sh ? a.sh + 3 * sh_coefficients(a.sh_degree) * i : nullptr;
  int degree = a.sh_degree;
  if constexpr (kDegree > 0) {
    __shared__ SharedRows<T, kDegree> rows;
    alignas(16) T row[RowLayout<T, kDegree>::kSize];
    rows.load(a.sh, i, seen, row);
    degree = kDegree;
    sh = row;
  }
  if (seen) {
    T length;
    Vec3<T> direction{};
    if (sh) direction = view_direction(camera, load_vec3(a.means + 3 * i), &length);
    seen = splat_features(a, direction, i, degree, sh, s.depth,
                          splat_feature_rows(a) + m * a.features);
  }
  uint64_t code = 0;
  if (i < a.count) {
    SplatGeometry<T> g{};
    if (seen) g = {s.x, s.y, SplatConic<T>::of(s), s.opacity, s.extent_x, s.extent_y};
    const_cast<SplatGeometry<T>*>(splat_geometry(a))[m] = g;
    if (seen) code = TileCode::of(g, a);
    o.keys[m] = seen ? __float_as_uint(static_cast<float>(s.depth)) : kCulledKey;
    o.ids[m] = static_cast<int32_t>(m);
    o.codes[m] = code;
    a.radii[m] = seen ? splat_radius(s) : 0;
  }
  const unsigned sum = __reduce_add_sync(0xffffffffu, TileCode::count(code));
  __shared__ unsigned long long block_sum;
  if (threadIdx.x == 0) block_sum = 0;
  __syncthreads();
  if (threadIdx.x % 32 == 0 && sum > 0) atomicAdd(&block_sum, static_cast<unsigned long long>(sum));
  __syncthreads();
  if (threadIdx.x == 0 && block_sum > 0) atomicAdd(o.total, block_sum);
}

}  // namespace

// Pinned memory and an event, so that the host can wait for the number without the sort behind it.
class ReadBack {
 public:
  unsigned long long* number = nullptr;
  cudaEvent_t event = nullptr;
};

ReadBack* read_back(int device) {
  constexpr int kDevices = 64;
  thread_local ReadBack slots[kDevices];
  if (device < 0 || device >= kDevices) return nullptr;
  ReadBack& slot = slots[device];
  if (!slot.number &&
      cudaHostAlloc(&slot.number, sizeof *slot.number, cudaHostAllocDefault) != cudaSuccess)
    return nullptr;
  if (!slot.event && cudaEventCreateWithFlags(&slot.event, cudaEventDisableTiming) != cudaSuccess)
    return nullptr;
  return &slot;
}

cudaError_t await_count(ReadBack* number, int64_t* count) {
  const cudaError_t error = cudaEventSynchronize(number->event);
  *count = static_cast<int64_t>(*number->number);
  return error;
}

template <typename T>
cudaError_t raster_project(const RasterArgs<T>& a, const RasterOrder& o, ReadBack* number,
                           cudaStream_t stream) {
  if (!number) return cudaErrorMemoryAllocation;
  cudaError_t error = cudaMemsetAsync(o.total, 0, sizeof *o.total, stream);
  if (error != cudaSuccess) return error;
  if (a.count > 0) {
    error = with_degree<T>(a.sh, a.sh_degree, [&]<int kDegree>() {
      const dim3 blocks(static_cast<unsigned>((a.count + kRowThreads - 1) / kRowThreads),
                        static_cast<unsigned>(a.cameras));
      project_kernel<T, kDegree><<<blocks, kRowThreads, 0, stream>>>(a, o);
      return cudaGetLastError();
    });
    if (error != cudaSuccess) return error;
  }
  error = cudaMemcpyAsync(number->number, o.total, sizeof *o.total, cudaMemcpyDeviceToHost, stream);
  return error == cudaSuccess ? cudaEventRecord(number->event, stream) : error;
}

template cudaError_t raster_project<float>(const RasterArgs<float>&, const RasterOrder&, ReadBack*,
                                           cudaStream_t);
template cudaError_t raster_project<double>(const RasterArgs<double>&, const RasterOrder&,
                                            ReadBack*, cudaStream_t);

}  // namespace gsf::cuda
