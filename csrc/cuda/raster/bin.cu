// Ordering on CUDA: one radix sort of the splats by depth, then one stable radix sort of the list
// entries by tile number alone. Equal depths keep their order, as on the CPU.
#include <thrust/iterator/counting_iterator.h>
#include <thrust/iterator/transform_iterator.h>

#include <cub/device/device_radix_sort.cuh>
#include <cub/device/device_scan.cuh>

#include "cuda/raster/launch.h"
#include "cuda/raster/layout.h"
#include "cuda/threads.h"

namespace gsf::cuda {
namespace {

constexpr unsigned kAllLanes = 0xffffffffu;
constexpr uint32_t kStaged = 512;      // list entries that a warp gathers before it writes them
constexpr int64_t kShortKeys = 65536;  // as many values fit 16 bits

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

struct CountOfRank {
  const uint64_t* codes;
  const int32_t* order;
  __device__ uint32_t operator()(int r) const { return TileCode::count(codes[order[r]]); }
};
using RankCounts = thrust::transform_iterator<CountOfRank, thrust::counting_iterator<int>>;

// Writes the list entries of the splats of 32 ranks; those of many tiles by the whole warp.
template <typename T, typename Key>
__global__ void __launch_bounds__(kThreads)
    emit_kernel(RasterArgs<T> a, RasterOrder o, Key* tiles, int32_t* ids) {
  const int64_t r = thread_number();
  const int lane = threadIdx.x % 32;
  const bool real = r < a.splat_count();
  const int32_t id = real ? o.order[r] : 0;
  const uint64_t code = real ? o.codes[id] : 0;
  const uint32_t begin = real ? o.offsets[r] : 0;  // lane 0 of a warp with work is real
  const auto first_tile = [&](int32_t splat) {
    return a.cameras == 1 ? 0 : static_cast<int>(splat / a.count) * a.tiles();
  };
  const bool many = TileCode::many(code);
  const uint32_t count = TileCode::count(code);
  // Entries of a warp's ranks are neighbours: through shared memory they leave as whole sectors.
  __shared__ Key staged_tiles[kThreads / 32][kStaged];
  __shared__ int32_t staged_ids[kThreads / 32][kStaged];
  Key* const own_tiles = staged_tiles[threadIdx.x / 32];
  int32_t* const own_ids = staged_ids[threadIdx.x / 32];
  const uint32_t start = __shfl_sync(kAllLanes, begin, 0);
  const uint32_t total = __reduce_add_sync(kAllLanes, count);
  const bool stage = total <= kStaged && !__any_sync(kAllLanes, many);
  if (!many) {
    const int base = first_tile(id) + TileCode::y(code) * a.tiles_x + TileCode::x(code);
    uint32_t e = stage ? begin - start : begin;
    Key* const to_tiles = stage ? own_tiles : tiles;
    int32_t* const to_ids = stage ? own_ids : ids;
    for (uint64_t mask = TileCode::mask(code); mask; mask &= mask - 1, ++e) {
      const int bit = __ffsll(static_cast<long long>(mask)) - 1;
      to_tiles[e] =
          static_cast<Key>(base + bit / TileCode::kEdge * a.tiles_x + bit % TileCode::kEdge);
      to_ids[e] = id;
    }
  }
  if (stage) {
    __syncwarp();
    for (uint32_t e = lane; e < total; e += 32) {
      tiles[start + e] = own_tiles[e];
      ids[start + e] = own_ids[e];
    }
    return;
  }
  for (unsigned wide = __ballot_sync(kAllLanes, many); wide; wide &= wide - 1) {
    const int source = __ffs(wide) - 1;
    const int32_t one = __shfl_sync(kAllLanes, id, source);
    uint32_t e = __shfl_sync(kAllLanes, begin, source);
    const uint32_t end = e + __shfl_sync(kAllLanes, count, source);
    const SplatGeometry<T> g = splat_geometry(a)[one];
    const SplatBands<T> bands(g, a);
    const int base = first_tile(one);
    for (int row = bands.y0; row < bands.y1; ++row) {
      int first, last;
      bands.columns(g, a, row, &first, &last);
      for (int x = first + lane; x < last; x += 32) {
        const uint32_t at = e + static_cast<uint32_t>(x - first);
        if (at < end) {
          tiles[at] = static_cast<Key>(base + row * a.tiles_x + x);
          ids[at] = one;
        }
      }
      e += static_cast<uint32_t>(last - first);
    }
    // Should rounding in this kernel give fewer tiles than in the other, the rest goes behind the
    // last tile, where nothing is drawn.
    const Key none = static_cast<Key>(a.tiles() * a.cameras);
    for (uint32_t at = e + lane; at < end; at += 32) tiles[at] = none, ids[at] = one;
  }
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
cudaError_t bin_with_keys(const RasterArgs<T>& a, const RasterOrder& o, void* scratch, size_t bytes,
                          cudaStream_t stream) {
  const int64_t n = a.instance_count;
  const int tile_count = a.tiles() * a.cameras, bits = bits_for(tile_count + 1);
  Carver carve{static_cast<char*>(scratch)};
  Key* tiles = carve.take<Key>(n);
  Key* sorted = carve.take<Key>(n);
  int32_t* ids = carve.take<int32_t>(n);
  size_t sort_bytes = tile_sort_bytes<Key>(n, bits);
  void* sort_scratch = carve.take<char>(static_cast<int64_t>(sort_bytes));
  if (carve.used > bytes) return cudaErrorInvalidValue;
  emit_kernel<T, Key><<<blocks_for(a.splat_count()), kThreads, 0, stream>>>(a, o, tiles, ids);
  const cudaError_t error = cub::DeviceRadixSort::SortPairs(sort_scratch, sort_bytes, tiles, sorted,
                                                            ids, a.instances, n, 0, bits, stream);
  if (error != cudaSuccess) return error;
  range_kernel<Key>
      <<<blocks_for(n + 1), kThreads, 0, stream>>>(sorted, n, tile_count, a.tile_start);
  return cudaGetLastError();
}

size_t depth_sort_bytes(int64_t splats) {
  size_t sort = 0, scan = 0;
  cub::DeviceRadixSort::SortPairs<uint32_t, int32_t>(nullptr, sort, nullptr, nullptr, nullptr,
                                                     nullptr, splats);
  cub::DeviceScan::ExclusiveSum(nullptr, scan, RankCounts({}, {}), static_cast<uint32_t*>(nullptr),
                                splats);
  return sort > scan ? sort : scan;
}

RasterOrder carve_order(Carver& carve, int64_t splats) {
  RasterOrder o{};
  o.keys = carve.take<uint32_t>(splats);
  o.ids = carve.take<int32_t>(splats);
  o.sorted = carve.take<uint32_t>(splats);
  o.order = carve.take<int32_t>(splats);
  o.codes = carve.take<uint64_t>(splats);
  o.offsets = carve.take<uint32_t>(splats);
  o.total = carve.take<unsigned long long>(1);
  o.temporary_bytes = depth_sort_bytes(splats);
  o.temporary = carve.take<char>(static_cast<int64_t>(o.temporary_bytes));
  return o;
}

}  // namespace

size_t raster_order_scratch(int64_t splats) {
  Carver carve{nullptr};
  carve_order(carve, splats);
  return carve.used;
}

RasterOrder carve_raster_order(void* scratch, int64_t splats) {
  Carver carve{static_cast<char*>(scratch)};
  return carve_order(carve, splats);
}

cudaError_t raster_sort(const RasterOrder& o, int64_t splats, cudaStream_t stream) {
  if (splats == 0) return cudaSuccess;
  size_t bytes = o.temporary_bytes;
  const cudaError_t error = cub::DeviceRadixSort::SortPairs(o.temporary, bytes, o.keys, o.sorted,
                                                            o.ids, o.order, splats, 0, 32, stream);
  if (error != cudaSuccess) return error;
  bytes = o.temporary_bytes;
  const RankCounts counts(thrust::counting_iterator<int>(0), CountOfRank{o.codes, o.order});
  return cub::DeviceScan::ExclusiveSum(o.temporary, bytes, counts, o.offsets, splats, stream);
}

size_t raster_bin_scratch(int64_t instances, int64_t tiles) {
  const bool small = tiles < kShortKeys;
  const size_t key = small ? sizeof(uint16_t) : sizeof(uint32_t);
  const int bits = bits_for(tiles + 1);
  const size_t sort = small ? tile_sort_bytes<uint16_t>(instances, bits)
                            : tile_sort_bytes<uint32_t>(instances, bits);
  return 2 * aligned(key * instances) + aligned(sizeof(int32_t) * instances) + aligned(sort);
}

template <typename T>
cudaError_t raster_bin(const RasterArgs<T>& a, const RasterOrder& o, void* scratch, size_t bytes,
                       cudaStream_t stream) {
  const int64_t tiles = int64_t(a.tiles()) * a.cameras;
  if (a.instance_count == 0)
    return cudaMemsetAsync(a.tile_start, 0, sizeof(int32_t) * (tiles + 1), stream);
  return tiles < kShortKeys ? bin_with_keys<T, uint16_t>(a, o, scratch, bytes, stream)
                            : bin_with_keys<T, uint32_t>(a, o, scratch, bytes, stream);
}

template cudaError_t raster_bin<float>(const RasterArgs<float>&, const RasterOrder&, void*, size_t,
                                       cudaStream_t);
template cudaError_t raster_bin<double>(const RasterArgs<double>&, const RasterOrder&, void*,
                                        size_t, cudaStream_t);

}  // namespace gsf::cuda
