// Ordering on CUDA: project, one radix sort of the Gaussians by depth, then one stable radix sort
// of the instances by tile number alone. Equal depths keep their order, as on the CPU.
#include <cub/device/device_radix_sort.cuh>
#include <cub/device/device_scan.cuh>

#include "cuda/launch_raster.h"

namespace gsf::cuda {
namespace {

constexpr int kThreads = 256;
constexpr uint32_t kCulled = 0xffffffffu;
constexpr int64_t kShortTiles = 65536;  // as many tiles fit 16-bit keys

int blocks_for(int64_t n) { return static_cast<int>((n + kThreads - 1) / kThreads); }

size_t aligned(size_t bytes) { return (bytes + 255) / 256 * 256; }

// Cuts a scratch buffer into aligned arrays.
struct Carver {
  char* base;
  size_t used = 0;
  template <typename T>
  T* take(int64_t count) {
    T* p = reinterpret_cast<T*>(base + used);
    used += aligned(sizeof(T) * static_cast<size_t>(count));
    return p;
  }
};

template <typename T>
__global__ void project_kernel(RasterArgs<T> a, uint32_t* keys, int32_t* ids) {
  const int64_t i = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i >= a.count) return;
  T* row = a.splats + i * a.stride;
  T depth = T(0);
  int32_t radius = 0;
  const bool seen = project_splat(a, raster_camera(a), i, row, &depth, &radius);
  if (!seen) row[kOpacity] = T(0);
  keys[i] = seen ? __float_as_uint(static_cast<float>(depth)) : kCulled;
  ids[i] = static_cast<int32_t>(i);
  a.radii[i] = seen ? radius : 0;
}

template <typename T>
__global__ void count_kernel(RasterArgs<T> a, int64_t* counts) {
  const int64_t r = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  if (r >= a.count) return;
  const T* row = a.splats + int64_t(a.order[r]) * a.stride;
  int64_t count = 0;
  if (row[kOpacity] > T(0)) {
    const PixelBox box = splat_tiles(row, a.width, a.height);
    count = int64_t(box.x1 - box.x0) * (box.y1 - box.y0);
  }
  counts[r] = count;
}

// One thread per instance: a splat that fills the screen is spread over as many threads as tiles.
template <typename T, typename Key>
__global__ void emit_kernel(RasterArgs<T> a, const int64_t* offsets, Key* tiles, int32_t* ids) {
  const int64_t e = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  if (e >= a.instance_count) return;
  int64_t low = 0, high = a.count - 1;  // first rank whose running total exceeds e
  while (low < high) {
    const int64_t middle = (low + high) / 2;
    if (offsets[middle] > e)
      high = middle;
    else
      low = middle + 1;
  }
  const int32_t id = a.order[low];
  const PixelBox box = splat_tiles(a.splats + int64_t(id) * a.stride, a.width, a.height);
  const int64_t local = e - (low > 0 ? offsets[low - 1] : 0);
  const int columns = box.x1 - box.x0;
  const int y = box.y0 + static_cast<int>(local / columns);
  const int x = box.x0 + static_cast<int>(local % columns);
  tiles[e] = static_cast<Key>(y * a.tiles_x + x);
  ids[e] = id;
}

template <typename Key>
__global__ void range_kernel(const Key* tiles, int64_t instances, int tile_count,
                             int32_t* tile_start) {
  const int64_t e = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  if (e > instances) return;
  const int first = e == 0 ? 0 : static_cast<int>(tiles[e - 1]) + 1;
  const int last = e == instances ? tile_count : static_cast<int>(tiles[e]);
  for (int t = first; t <= last; ++t) tile_start[t] = static_cast<int32_t>(e);
}

int bits_for(int64_t values) {
  int bits = 1;
  while ((int64_t(1) << bits) < values) ++bits;
  return bits;
}

template <typename Key>
size_t tile_sort_bytes(int64_t instances, int bits) {
  size_t bytes = 0;
  cub::DeviceRadixSort::SortPairs<Key, int32_t>(nullptr, bytes, nullptr, nullptr, nullptr, nullptr,
                                                instances, 0, bits);
  return bytes;
}

template <typename T, typename Key>
cudaError_t bin_with_keys(const RasterArgs<T>& a, void* scratch, size_t bytes,
                          const int64_t* offsets, cudaStream_t stream) {
  const int64_t n = a.instance_count;
  const int tile_count = a.tiles_x * a.tiles_y, bits = bits_for(tile_count);
  Carver carve{static_cast<char*>(scratch)};
  Key* tiles = carve.take<Key>(n);
  Key* sorted = carve.take<Key>(n);
  int32_t* ids = carve.take<int32_t>(n);
  size_t sort_bytes = tile_sort_bytes<Key>(n, bits);
  void* sort_scratch = carve.take<char>(static_cast<int64_t>(sort_bytes));
  if (carve.used > bytes) return cudaErrorInvalidValue;
  emit_kernel<T, Key><<<blocks_for(n), kThreads, 0, stream>>>(a, offsets, tiles, ids);
  const cudaError_t error = cub::DeviceRadixSort::SortPairs(sort_scratch, sort_bytes, tiles, sorted,
                                                            ids, a.instances, n, 0, bits, stream);
  if (error != cudaSuccess) return error;
  range_kernel<Key>
      <<<blocks_for(n + 1), kThreads, 0, stream>>>(sorted, n, tile_count, a.tile_start);
  return cudaGetLastError();
}

}  // namespace

size_t raster_order_scratch(int64_t count) {
  size_t sort = 0, scan = 0;
  cub::DeviceRadixSort::SortPairs<uint32_t, int32_t>(nullptr, sort, nullptr, nullptr, nullptr,
                                                     nullptr, count);
  cub::DeviceScan::InclusiveSum(nullptr, scan, static_cast<int64_t*>(nullptr),
                                static_cast<int64_t*>(nullptr), count);
  return 2 * aligned(sizeof(uint32_t) * count) + aligned(sizeof(int32_t) * count) +
         aligned(sizeof(int64_t) * count) + aligned(sort) + aligned(scan);
}

template <typename T>
cudaError_t raster_order(const RasterArgs<T>& a, void* scratch, size_t bytes, int64_t* offsets,
                         int64_t* total, cudaStream_t stream) {
  *total = 0;
  if (a.count == 0) return cudaSuccess;
  size_t sort_bytes = 0, scan_bytes = 0;
  cub::DeviceRadixSort::SortPairs<uint32_t, int32_t>(nullptr, sort_bytes, nullptr, nullptr, nullptr,
                                                     nullptr, a.count);
  cub::DeviceScan::InclusiveSum(nullptr, scan_bytes, static_cast<int64_t*>(nullptr),
                                static_cast<int64_t*>(nullptr), a.count);
  Carver carve{static_cast<char*>(scratch)};
  uint32_t* keys = carve.take<uint32_t>(a.count);
  uint32_t* sorted = carve.take<uint32_t>(a.count);
  int32_t* ids = carve.take<int32_t>(a.count);
  int64_t* counts = carve.take<int64_t>(a.count);
  void* sort_scratch = carve.take<char>(static_cast<int64_t>(sort_bytes));
  void* scan_scratch = carve.take<char>(static_cast<int64_t>(scan_bytes));
  if (carve.used > bytes) return cudaErrorInvalidValue;

  const int blocks = blocks_for(a.count);
  project_kernel<T><<<blocks, kThreads, 0, stream>>>(a, keys, ids);
  cudaError_t error = cub::DeviceRadixSort::SortPairs(sort_scratch, sort_bytes, keys, sorted, ids,
                                                      a.order, a.count, 0, 32, stream);
  if (error != cudaSuccess) return error;
  count_kernel<T><<<blocks, kThreads, 0, stream>>>(a, counts);
  error = cub::DeviceScan::InclusiveSum(scan_scratch, scan_bytes, counts, offsets, a.count, stream);
  if (error != cudaSuccess) return error;
  error = cudaMemcpyAsync(total, offsets + a.count - 1, sizeof(int64_t), cudaMemcpyDeviceToHost,
                          stream);
  if (error != cudaSuccess) return error;
  return cudaStreamSynchronize(stream);
}

size_t raster_bin_scratch(int64_t instances, int64_t tiles) {
  const bool small = tiles <= kShortTiles;
  const size_t key = small ? sizeof(uint16_t) : sizeof(uint32_t);
  const int bits = bits_for(tiles);
  const size_t sort = small ? tile_sort_bytes<uint16_t>(instances, bits)
                            : tile_sort_bytes<uint32_t>(instances, bits);
  return 2 * aligned(key * instances) + aligned(sizeof(int32_t) * instances) + aligned(sort);
}

template <typename T>
cudaError_t raster_bin(const RasterArgs<T>& a, void* scratch, size_t bytes, const int64_t* offsets,
                       cudaStream_t stream) {
  const int64_t tiles = int64_t(a.tiles_x) * a.tiles_y;
  if (a.instance_count == 0)
    return cudaMemsetAsync(a.tile_start, 0, sizeof(int32_t) * (tiles + 1), stream);
  return tiles <= kShortTiles ? bin_with_keys<T, uint16_t>(a, scratch, bytes, offsets, stream)
                              : bin_with_keys<T, uint32_t>(a, scratch, bytes, offsets, stream);
}

template cudaError_t raster_order<float>(const RasterArgs<float>&, void*, size_t, int64_t*,
                                         int64_t*, cudaStream_t);
template cudaError_t raster_order<double>(const RasterArgs<double>&, void*, size_t, int64_t*,
                                          int64_t*, cudaStream_t);
template cudaError_t raster_bin<float>(const RasterArgs<float>&, void*, size_t, const int64_t*,
                                       cudaStream_t);
template cudaError_t raster_bin<double>(const RasterArgs<double>&, void*, size_t, const int64_t*,
                                        cudaStream_t);

}  // namespace gsf::cuda
