// Ordering on the CPU: project, sort by depth, list the splats of every tile front to back. Every
// step is stable and independent of the number of threads, so results are bit-identical for any.
#pragma once

#include <atomic>
#include <bit>
#include <memory>
#include <numeric>
#include <vector>

#include "cpu/raster/packet.h"
#include "torch_api.h"

namespace gsf::raster_cpu {

// Hands tasks to the threads one by one: tiles differ a hundredfold in work.
template <typename F>
void dynamic_for(int64_t count, const F& task) {
  std::atomic<int64_t> next{0};
  parallel_for(std::min<int64_t>(torch::stable::get_num_threads(), count), 1,
               [&](int64_t begin, int64_t end) {
                 for (; begin < end; ++begin)
                   for (int64_t i; (i = next.fetch_add(1, std::memory_order_relaxed)) < count;)
                     task(i);
               });
}

// [0, n) in at most one part per thread, none below `grain`: what is counted per part, summed up
// and used in a second pass over the same parts.
struct Parts {
  int64_t n, count;
  Parts(int64_t size, int64_t grain)
      : n(size), count(std::clamp<int64_t>(size / grain, 1, torch::stable::get_num_threads())) {}
  int64_t first(int64_t part) const { return n * part / count; }
  template <typename F>  // f(part, begin, end)
  void run(const F& f) const {
    parallel_for(count, 1, [&](int64_t begin, int64_t end) {
      for (int64_t p = begin; p < end; ++p) f(p, first(p), first(p + 1));
    });
  }
};

// Stable radix sort of (key << 32 | value) by the lowest `bits` bits of the key.
inline void sort_by_key(std::vector<uint64_t>& items, int bits) {
  constexpr int kBits = 11, kBuckets = 1 << kBits;
  const Parts parts(static_cast<int64_t>(items.size()), 16384);
  std::vector<uint64_t> other(items.size());
  std::vector<uint32_t> start;
  for (int shift = 32; shift < 32 + bits; shift += kBits) {
    const auto bucket = [&](uint64_t item) { return item >> shift & (kBuckets - 1); };
    start.assign(static_cast<size_t>(parts.count) * kBuckets, 0);
    parts.run([&](int64_t p, int64_t begin, int64_t end) {
      uint32_t* counts = start.data() + p * kBuckets;
      for (int64_t k = begin; k < end; ++k) ++counts[bucket(items[k])];
    });
    uint32_t sum = 0;
    for (int b = 0; b < kBuckets; ++b)
      for (int64_t p = 0; p < parts.count; ++p) sum += std::exchange(start[p * kBuckets + b], sum);
    parts.run([&](int64_t p, int64_t begin, int64_t end) {
      uint32_t* place = start.data() + p * kBuckets;
      for (int64_t k = begin; k < end; ++k) other[place[bucket(items[k])]++] = items[k];
    });
    items.swap(other);
  }
}

template <typename T>
std::vector<SplatCamera<T>> raster_cameras(const RasterArgs<T>& a) {
  std::vector<SplatCamera<T>> cameras;
  for (int c = 0; c < a.cameras; ++c) cameras.push_back(raster_camera(a, c));
  return cameras;
}

// The tile lists of all cameras. Saved for the adjoint: rows of `splats`, `order` (the instances of
// all splats before this one), tile_start, and in `instances` the splats themselves.
template <typename T>
class TileLists {
 public:
  // Projects and counts; writes splats, order and radii.
  explicit TileLists(const RasterArgs<T>& a)
      : a_(a),
        depth_(new T[static_cast<size_t>(a.splat_count())]),
        box_(new TileBox[static_cast<size_t>(a.splat_count())]) {
    std::vector<SplatCamera<cpu::Pack<T>>> cameras;
    for (const SplatCamera<T>& camera : raster_cameras(a)) cameras.push_back(packed(camera));
    const Parts parts(a.splat_count(), 512);
    std::vector<int64_t> first(static_cast<size_t>(parts.count), 0);
    parts.run(
        [&](int64_t p, int64_t begin, int64_t end) { first[p] = project(cameras, begin, end); });
    for (int64_t& f : first) total_ += std::exchange(f, total_);
    if (total_ > INT32_MAX) return;  // the host refuses them
    parts.run([&](int64_t p, int64_t begin, int64_t end) {
      int64_t before = first[p];
      for (int64_t s = begin; s < end; ++s) {
        a.order[s] = static_cast<int32_t>(before);
        before += box_[s].count();
      }
    });
  }

  int64_t total() const { return total_; }
  const T* depth() const { return depth_.get(); }

  // Writes tile_start and instances (of size total()).
  void fill() {
    std::vector<std::vector<uint64_t>> sorted(static_cast<size_t>(a_.cameras));
    // Many cameras are sorted side by side, few one after the other on all threads.
    const auto sort = [&](int64_t c) { sorted[c] = by_depth(c); };
    if (static_cast<uint32_t>(a_.cameras) < torch::stable::get_num_threads())
      for (int c = 0; c < a_.cameras; ++c) sort(c);
    else
      dynamic_for(a_.cameras, sort);

    // A task lists the splats of some rows of tiles of one camera.
    const int bands = std::min<int>(a_.tiles_y, 2 * torch::stable::get_num_threads());
    const auto each_band = [&](const auto& f) {
      dynamic_for(int64_t(a_.cameras) * bands, [&](int64_t task) {
        const int64_t c = task / bands, band = task % bands;
        f(static_cast<int>(c), static_cast<int>(a_.tiles_y * band / bands),
          static_cast<int>(a_.tiles_y * (band + 1) / bands));
      });
    };
    std::vector<int32_t> cursor(static_cast<size_t>(a_.cameras) * a_.tiles());
    each_band([&](int c, int y0, int y1) {
      count_band(c, y0, y1, cursor.data() + int64_t(c) * a_.tiles());
    });
    int32_t sum = 0;
    for (size_t t = 0; t < cursor.size(); ++t) {
      a_.tile_start[t] = sum;
      sum += std::exchange(cursor[t], sum);
    }
    a_.tile_start[cursor.size()] = sum;
    each_band([&](int c, int y0, int y1) {
      fill_band(sorted[c], y0, y1, cursor.data() + int64_t(c) * a_.tiles());
    });
  }

 private:
  // Splats [begin, end), packets of one camera each. Returns the number of tiles.
  int64_t project(const std::vector<SplatCamera<cpu::Pack<T>>>& cameras, int64_t begin,
                  int64_t end) {
    int64_t tiles = 0;
    for (int64_t s = begin, used; s < end; s += used) {
      const int64_t camera = s / a_.count, first = s % a_.count;
      used = std::min<int64_t>({kPacket<T>, end - s, a_.count - first});
      tiles += project_packet(a_, cameras[camera],
                              PacketRows<T>{first, a_.count, static_cast<int>(used)}, s, box_.get(),
                              depth_.get());
    }
    return tiles;
  }

  // The visible splats of camera `c`, (key << 32 | splat), nearest first; equal depths keep the
  // order of the inputs.
  std::vector<uint64_t> by_depth(int64_t c) const {
    const int64_t offset = c * a_.count;
    const Parts parts(a_.count, 8192);
    struct Range {
      int64_t first = 0;
      uint32_t low = ~0u, high = 0;
    };
    std::vector<Range> ranges(static_cast<size_t>(parts.count));
    // Bits of a positive float order like the float.
    const auto key = [&](int64_t s) {
      return std::bit_cast<uint32_t>(static_cast<float>(depth_[s]));
    };
    parts.run([&](int64_t p, int64_t begin, int64_t end) {
      Range r;
      for (int64_t s = offset + begin; s < offset + end; ++s) {
        if (box_[s].count() == 0) continue;
        ++r.first;
        r.low = std::min(r.low, key(s));
        r.high = std::max(r.high, key(s));
      }
      ranges[p] = r;
    });
    int64_t visible = 0;
    uint32_t low = ~0u, high = 0;
    for (Range& r : ranges) {
      visible += std::exchange(r.first, visible);
      low = std::min(low, r.low);
      high = std::max(high, r.high);
    }
    std::vector<uint64_t> items(static_cast<size_t>(visible));
    parts.run([&](int64_t p, int64_t begin, int64_t end) {
      uint64_t* out = items.data() + ranges[p].first;
      for (int64_t s = offset + begin; s < offset + end; ++s)
        if (box_[s].count() > 0) *out++ = uint64_t(key(s) - low) << 32 | uint64_t(s);
    });
    if (visible > 0) sort_by_key(items, std::bit_width(high - low));
    return items;
  }

  // Instances of the tiles in rows [y0, y1) of camera `c`: corners of the boxes, then their running
  // sums along both axes.
  void count_band(int c, int y0, int y1, int32_t* count) const {
    const int wide = a_.tiles_x + 1;
    std::vector<int32_t> corner(static_cast<size_t>(wide) * (y1 - y0 + 1), 0);
    const TileBox* box = box_.get() + c * a_.count;
    for (int64_t i = 0; i < a_.count; ++i) {
      const int top = std::max<int>(box[i].y0, y0) - y0, end = std::min<int>(box[i].y1, y1) - y0;
      if (top >= end) continue;
      ++corner[top * wide + box[i].x0];
      --corner[top * wide + box[i].x1];
      --corner[end * wide + box[i].x0];
      ++corner[end * wide + box[i].x1];
    }
    for (int y = 0; y < y1 - y0; ++y) {
      int32_t sum = 0;
      for (int x = 0; x < a_.tiles_x; ++x) {
        sum += corner[y * wide + x];
        count[(y + y0) * a_.tiles_x + x] = sum + (y > 0 ? count[(y + y0 - 1) * a_.tiles_x + x] : 0);
      }
    }
  }

  void fill_band(const std::vector<uint64_t>& sorted, int y0, int y1, int32_t* cursor) const {
    for (const uint64_t item : sorted) {
      const int32_t s = static_cast<int32_t>(item & 0xffffffffu);
      const TileBox box = box_[s];
      const int end = std::min<int>(box.y1, y1);
      for (int y = std::max<int>(box.y0, y0); y < end; ++y)
        for (int x = box.x0; x < box.x1; ++x) a_.instances[cursor[y * a_.tiles_x + x]++] = s;
    }
  }

  const RasterArgs<T>& a_;
  std::unique_ptr<T[]> depth_;
  std::unique_ptr<TileBox[]> box_;
  int64_t total_ = 0;
};

// True when the lists the adjoint is handed back can be walked without leaving their arrays. That
// an instance belongs to its splat is checked where it is used.
template <typename T>
bool lists_are_sound(const RasterArgs<T>& a) {
  const int64_t tiles = int64_t(a.tiles()) * a.cameras, splats = a.splat_count();
  bool sound = a.tile_start[0] == 0 && a.tile_start[tiles] == a.instance_count;
  for (int64_t t = 0; t < tiles; ++t) sound &= a.tile_start[t] <= a.tile_start[t + 1];
  for (int64_t s = 0; s < splats; ++s)
    sound &= a.order[s] >= 0 &&
             a.order[s] <= (s + 1 < splats ? int64_t(a.order[s + 1]) : a.instance_count);
  if (!sound) return false;
  for (int64_t c = 0; c < a.cameras; ++c)
    for (int64_t e = a.tile_start[c * a.tiles()]; e < a.tile_start[(c + 1) * a.tiles()]; ++e)
      sound &= static_cast<uint64_t>(a.instances[e] - c * a.count) < static_cast<uint64_t>(a.count);
  return sound;
}

// Tiles by falling number of instances, so that the last tasks handed out are short ones.
template <typename T>
std::vector<int32_t> tiles_by_work(const RasterArgs<T>& a) {
  std::vector<uint64_t> items(static_cast<size_t>(a.tiles()) * a.cameras);
  int32_t most = 0;
  const auto work = [&](size_t t) { return a.tile_start[t + 1] - a.tile_start[t]; };
  for (size_t t = 0; t < items.size(); ++t) most = std::max(most, work(t));
  for (size_t t = 0; t < items.size(); ++t) items[t] = uint64_t(most - work(t)) << 32 | uint64_t(t);
  sort_by_key(items, std::bit_width(static_cast<uint32_t>(most)));
  std::vector<int32_t> order(items.size());
  for (size_t k = 0; k < items.size(); ++k) order[k] = static_cast<int32_t>(items[k]);
  return order;
}

}  // namespace gsf::raster_cpu
