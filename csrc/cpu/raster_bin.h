// Ordering on the CPU: project, sort by depth, list the splats of every tile front to back. Every
// step is stable and independent of the number of threads, so results are bit-identical for any.
#pragma once

#include <atomic>
#include <bit>
#include <memory>
#include <numeric>
#include <utility>
#include <vector>

#include "core/raster.h"
#include "torch_api.h"

namespace gsf::raster_cpu {

// Hands tasks to the threads one by one: tiles differ a hundredfold in work.
template <typename F>
void dynamic_for(int64_t count, const F& task) {
  std::atomic<int64_t> next{0};
  parallel_for(torch::stable::get_num_threads(), 1, [&](int64_t begin, int64_t end) {
    for (; begin < end; ++begin)
      for (int64_t i; (i = next.fetch_add(1, std::memory_order_relaxed)) < count;) task(i);
  });
}

// Stable radix sort of (key << 32 | value) by key, three passes of 11 bits.
inline void sort_by_key(std::vector<uint64_t>& items) {
  constexpr int kBits = 11, kBuckets = 1 << kBits;
  std::vector<uint64_t> other(items.size());
  for (int shift = 32; shift < 64; shift += kBits) {
    std::vector<uint32_t> start(kBuckets + 1, 0);
    for (uint64_t item : items) ++start[(item >> shift & (kBuckets - 1)) + 1];
    std::partial_sum(start.begin(), start.end(), start.begin());
    for (uint64_t item : items) other[start[item >> shift & (kBuckets - 1)]++] = item;
    items.swap(other);
  }
}

// Fills splats (in depth order), order and radii. Returns the number of visible splats.
template <typename T>
int64_t project_and_sort(const RasterArgs<T>& a) {
  constexpr uint32_t kCulled = 0xffffffffu;
  constexpr int64_t kAhead = 8;  // rows asked for before they are copied
  const SplatCamera<T> camera = raster_camera(a);
  // Uninitialised on purpose: rows of culled splats are never read.
  std::unique_ptr<T[]> rows(new T[static_cast<size_t>(a.count) * a.stride]);
  std::unique_ptr<uint32_t[]> keys(new uint32_t[static_cast<size_t>(a.count)]);
  parallel_for(a.count, 512, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      T depth = T(0);
      int32_t radius = 0;
      const bool seen = project_splat(a, camera, i, rows.get() + i * a.stride, &depth, &radius);
      // Bits of a positive float order like the float.
      keys[i] = seen ? std::bit_cast<uint32_t>(static_cast<float>(depth)) : kCulled;
      a.radii[i] = seen ? radius : 0;
    }
  });
  std::vector<uint64_t> items;
  items.reserve(static_cast<size_t>(a.count));
  for (int64_t i = 0; i < a.count; ++i)
    if (keys[i] != kCulled) items.push_back(uint64_t(keys[i]) << 32 | uint64_t(i));
  sort_by_key(items);
  const int64_t visible = static_cast<int64_t>(items.size());
  const int used = kFeatures + a.features;
  parallel_for(a.count, 2048, [&](int64_t begin, int64_t end) {
    for (int64_t r = begin; r < end; ++r) {
      if (r + kAhead < visible)
        __builtin_prefetch(rows.get() + (items[r + kAhead] & 0xffffffffu) * a.stride);
      const int64_t i = r < visible ? static_cast<int64_t>(items[r] & 0xffffffffu) : -1;
      a.order[r] = static_cast<int32_t>(i);
      if (i >= 0) std::copy_n(rows.get() + i * a.stride, used, a.splats + r * a.stride);
    }
  });
  return visible;
}

// Calls f(tile, rank) for the tiles of ranks [begin, end), rank by rank.
template <typename T, typename F>
void for_each_instance(const RasterArgs<T>& a, int64_t begin, int64_t end, const F& f) {
  for (int64_t r = begin; r < end; ++r) {
    const PixelBox box = splat_tiles(a.splats + r * a.stride, a.width, a.height);
    for (int y = box.y0; y < box.y1; ++y)
      for (int x = box.x0; x < box.x1; ++x) f(y * a.tiles_x + x, r);
  }
}

// Tile lists by a counting sort over chunks of ranks: count, prefix over (tile, chunk), scatter.
template <typename T>
class TileLists {
 public:
  TileLists(const RasterArgs<T>& a, int64_t visible)
      : a_(a), visible_(visible), tiles_(int64_t(a.tiles_x) * a.tiles_y) {
    chunks_ = std::clamp<int64_t>(visible / 4096, 1, torch::stable::get_num_threads());
    cursor_.assign(static_cast<size_t>(chunks_ * tiles_), 0);
    parallel_for(chunks_, 1, [&](int64_t begin, int64_t end) {
      for (int64_t k = begin; k < end; ++k) {
        int64_t* count = cursor_.data() + k * tiles_;
        for_each_instance(a_, first(k), first(k + 1), [&](int t, int64_t) { ++count[t]; });
      }
    });
    for (int64_t t = 0; t < tiles_; ++t)
      for (int64_t k = 0; k < chunks_; ++k)
        total_ += std::exchange(cursor_[k * tiles_ + t], total_);
  }

  int64_t total() const { return total_; }

  // Needs tile_start and instances (of size total()).
  void fill() {
    for (int64_t t = 0; t < tiles_; ++t) a_.tile_start[t] = static_cast<int32_t>(cursor_[t]);
    a_.tile_start[tiles_] = static_cast<int32_t>(total_);
    parallel_for(chunks_, 1, [&](int64_t begin, int64_t end) {
      for (int64_t k = begin; k < end; ++k) {
        int64_t* cursor = cursor_.data() + k * tiles_;
        for_each_instance(a_, first(k), first(k + 1), [&](int t, int64_t r) {
          a_.instances[cursor[t]++] = static_cast<int32_t>(r);
        });
      }
    });
  }

 private:
  int64_t first(int64_t chunk) const { return visible_ * chunk / chunks_; }

  const RasterArgs<T>& a_;
  int64_t visible_, tiles_, chunks_ = 1, total_ = 0;
  std::vector<int64_t> cursor_;
};

// Visible splats are the rows before the first -1 of `order`.
template <typename T>
int64_t visible_count(const RasterArgs<T>& a) {
  return std::find_if(a.order, a.order + a.count, [](int32_t i) { return i < 0; }) - a.order;
}

// True when the lists the adjoint is handed back can be walked without leaving their arrays.
template <typename T>
bool lists_are_sound(const RasterArgs<T>& a, int64_t visible) {
  const int64_t tiles = int64_t(a.tiles_x) * a.tiles_y;
  bool sound = a.tile_start[0] == 0 && a.tile_start[tiles] == a.instance_count;
  for (int64_t t = 0; t < tiles; ++t) sound &= a.tile_start[t] <= a.tile_start[t + 1];
  for (int64_t r = 0; r < visible; ++r) sound &= a.order[r] < a.count;
  for (int64_t e = 0; e < a.instance_count; ++e)
    sound &= static_cast<uint32_t>(a.instances[e]) < static_cast<uint64_t>(visible);
  return sound;
}

// first_slot[r]: instances of the ranks before r; one more entry holds their total.
template <typename T>
std::vector<int64_t> instance_offsets(const RasterArgs<T>& a, int64_t visible) {
  std::vector<int64_t> first(static_cast<size_t>(visible) + 1, 0);
  for (int64_t r = 0; r < visible; ++r) {
    const PixelBox box = splat_tiles(a.splats + r * a.stride, a.width, a.height);
    first[r + 1] = first[r] + int64_t(box.x1 - box.x0) * (box.y1 - box.y0);
  }
  return first;
}

// Tiles by falling number of instances, so that the last tasks handed out are short ones.
template <typename T>
std::vector<int32_t> tiles_by_work(const RasterArgs<T>& a) {
  const int64_t tiles = int64_t(a.tiles_x) * a.tiles_y;
  std::vector<uint64_t> items(static_cast<size_t>(tiles));
  for (int64_t t = 0; t < tiles; ++t) {
    const uint32_t work = static_cast<uint32_t>(a.tile_start[t + 1] - a.tile_start[t]);
    items[t] = uint64_t(~work) << 32 | uint64_t(t);
  }
  sort_by_key(items);
  std::vector<int32_t> order(items.size());
  for (size_t k = 0; k < items.size(); ++k) order[k] = static_cast<int32_t>(items[k]);
  return order;
}

}  // namespace gsf::raster_cpu
