// CPU kernels of the spatial ops.
#include "host/spatial.h"

#include <algorithm>
#include <atomic>
#include <vector>

namespace gsf {
namespace {

// The points of every cell one after the other.
void fill_table(const NearestArgs& a, double edge, int32_t* bucket) {
  parallel_for(a.points, 4096, [&](int64_t first, int64_t last) {
    for (int64_t i = first; i < last; ++i) bucket[i] = int32_t(bucket_of_point(a, i, edge));
  });
  std::fill(a.count, a.count + a.buckets, 0);
  for (int64_t i = 0; i < a.points; ++i)
    if (bucket[i] >= 0) ++a.count[bucket[i]];
  int32_t used = 0;
  for (int64_t b = 0; b < a.buckets; ++b) {
    a.end[b] = used;
    used += a.count[b];
  }
  for (int64_t i = 0; i < a.points; ++i)
    if (bucket[i] >= 0) a.row[a.end[bucket[i]]++] = int32_t(i);
}

// Looks for the nearest points of query i; whether it has them.
bool ask(const NearestArgs& a, int64_t i, double edge, bool last) {
  const NearestList list(a, i);
  list.clear();
  const double* place = a.query + 3 * i;
  const double reach = a.reach * a.reach * (1.0 + kCellSlack);
  const double& worst = list.square[a.wanted - 1];
  bool done = last || !finite_place(place);
  int64_t middle[3], cell[3];
  double away;
  if (cell_at(place, edge, middle)) {
    // squared ways along each axis to the cells around
    constexpr int kSide = 2 * kNearestRings + 1;
    double way[3][kSide];
    for (int axis = 0; axis < 3; ++axis)
      for (int step = 0; step < kSide; ++step) {
        const double low = double(middle[axis] + step - kNearestRings) * edge;
        const double off = std::max(low - place[axis], place[axis] - (low + edge));
        const double far = std::max(off - kCellSlack * edge, 0.0);
        way[axis][step] = far * far;
      }
    for (int ring = 0; ring <= kNearestRings && !(done && ring); ++ring) {
      const int first = kNearestRings - ring, past = kNearestRings + ring + 1;
      for (int x = first; x < past; ++x)
        for (int y = first; y < past; ++y) {
          // within the faces of the ring its cells are the first and the last
          const bool face = x == first || x == past - 1 || y == first || y == past - 1;
          for (int z = first; z < past; z += face ? 1 : 2 * ring) {
            if (way[0][x] + way[1][y] + way[2][z] > std::min(worst, reach)) continue;
            cell[0] = middle[0] + x - kNearestRings;
            cell[1] = middle[1] + y - kNearestRings;
            cell[2] = middle[2] + z - kNearestRings;
            const int64_t bucket = bucket_of(a, cell, group_of(a.asked, i));
            for (int32_t k = a.end[bucket] - a.count[bucket]; k < a.end[bucket]; ++k)
              if (candidate(a, i, a.row[k], cell, edge, worst, list.index[a.wanted - 1], &away))
                list.take(a.row[k], away);
          }
        }
      done = done || settled(a, i, worst, ring * edge * (1.0 - kCellSlack));
    }
  }
  a.done[i] = done;
  if (done) list.finish(a.reach);
  return done;
}

struct SpatialCpu {
  using Scope = CpuScope;

  static void nearest_labels(const NearestLabelsArgs& a, const Scope&) {
    // each thread has layers of its own and asks all points
    const int64_t plane = a.shape[1] * a.shape[2];
    parallel_for(a.shape[0], 8, [&](int64_t begin, int64_t end) {
      std::fill(a.best + begin * plane, a.best + end * plane, kNoKey);
      for (int64_t i = 0; i < a.count; ++i)
        named_voxels(a, i, begin, end,
                     [&](int64_t voxel, int64_t key) { a.best[voxel] = min(a.best[voxel], key); });
      for (int64_t k = begin * plane; k < end * plane; ++k) a.labels[k] = a.label(k);
    });
  }

  static void largest_shares(const LargestSharesArgs& a, const Scope&) {
    // places that follow each other are close: few of the fields meet a run of them
    constexpr int64_t kRun = 256;
    parallel_for((a.count + kRun - 1) / kRun, 16, [&](int64_t begin, int64_t end) {
      std::vector<int64_t> met;
      for (int64_t run = begin; run < end; ++run) {
        const int64_t from = run * kRun, to = std::min(a.count, from + kRun);
        float places[3 * kRun], low[3], high[3];
        for (int axis = 0; axis < 3; ++axis) {
          low[axis] = HUGE_VALF;
          high[axis] = -HUGE_VALF;
        }
        for (int64_t i = from; i < to; ++i) {
          float* place = places + 3 * (i - from);
          place_of(a, i, place);
          for (int axis = 0; axis < 3; ++axis) {
            low[axis] = std::fmin(low[axis], place[axis]);
            high[axis] = std::fmax(high[axis], place[axis]);
          }
        }
        met.clear();
        for (int64_t label = 0; label < a.fields; ++label)
          if (meets(a, label, low, high)) met.push_back(label);
        for (int64_t i = from; i < to; ++i) {
          const float* place = places + 3 * (i - from);
          TwoLargest found;
          for (const int64_t label : met)
            if (meets(a, label, place, place)) show(a, label, place, &found);
          settle(a, i, found);
        }
      }
    });
  }

  static void nearest_points(const NearestArgs& a, const Scope&) {
    for (int k = 0; k < 6; ++k) a.box[k] = ordered(k < 3 ? HUGE_VAL : -HUGE_VAL);
    for (int64_t i = 0; i < a.points; ++i) {
      if (!finite_place(a.point + 3 * i)) continue;
      for (int axis = 0; axis < 3; ++axis) {
        const int64_t value = ordered(a.point[3 * i + axis]);
        a.box[axis] = std::min(a.box[axis], value);
        a.box[axis + 3] = std::max(a.box[axis + 3], value);
      }
    }
    std::fill(a.done, a.done + a.queries, uint8_t(0));
    std::vector<int32_t> bucket(a.points);
    bool left = a.queries > 0;
    for (int level = 0; left && level < kNearestLevels; ++level) {
      const double edge = level_cell(a, level);
      fill_table(a, edge, bucket.data());
      std::atomic<bool> some{false};
      parallel_for(a.queries, 256, [&](int64_t first, int64_t last) {
        for (int64_t i = first; i < last; ++i)
          if (!a.done[i] && !ask(a, i, edge, level == kNearestLevels - 1)) some = true;
      });
      left = some;
    }
  }

  static void box_sum(const BoxSumArgs& a, const Scope&) {
    const int64_t rows = a.shape[1], row = a.shape[2], half = a.half;
    // whole rows are added: neighbours in memory
    const auto add = [](int32_t* out, const int32_t* in, int64_t count) {
      for (int64_t z = 0; z < count; ++z) out[z] += in[z];
    };
    parallel_for(a.shape[0], 8, [&](int64_t begin, int64_t end) {
      for (int64_t x = begin; x < end; ++x)
        for (int64_t y = 0; y < rows; ++y) {
          const int64_t here = (x * rows + y) * row;
          int32_t* out = a.out + here;
          std::copy(a.in + here, a.in + here + row, out);
          const int64_t stride = a.axis == 0 ? rows * row : row;
          const int64_t at = a.axis == 0 ? x : y, most = a.shape[a.axis] - 1;
          for (int64_t k = 1; k <= half; ++k) {
            if (a.axis == 2) {
              add(out, a.in + here + k, row - k);
              add(out + k, a.in + here, row - k);
              continue;
            }
            if (at - k >= 0) add(out, a.in + here - k * stride, row);
            if (at + k <= most) add(out, a.in + here + k * stride, row);
          }
        }
    });
  }

  static void distance_pass(const DistanceArgs& a, const Scope&) {
    const int64_t count = a.shape[a.axis];
    if (a.axis == 2) {
      parallel_for(a.voxels() / count, 64, [&](int64_t begin, int64_t end) {
        for (int64_t line = begin; line < end; ++line) distances_along(a, line);
      });
      return;
    }
    // Lines that begin side by side go through memory together, a line of the cache at a time.
    constexpr int64_t kSide = 16;
    const int64_t row = a.axis == 0 ? a.shape[1] * a.shape[2] : a.shape[2];
    const int64_t tiles = (row + kSide - 1) / kSide, stride = a.stride();
    parallel_for(a.voxels() / count / row * tiles, 8, [&](int64_t begin, int64_t end) {
      const bool named = a.next_source != nullptr;
      std::vector<int32_t> held((named ? 5 : 3) * kSide * count);
      int32_t* const square = held.data();
      int32_t* const stack = square + kSide * count;
      int32_t* const next = stack + kSide * count;
      int32_t* const source = named ? next + kSide * count : nullptr;
      int32_t* const named_next = named ? source + kSide * count : nullptr;
      for (int64_t tile = begin; tile < end; ++tile) {
        const int64_t column = tile % tiles * kSide, side = std::min(kSide, row - column);
        const int64_t base = a.first(tile / tiles * row + column);
        const auto each = [&](auto&& move) {
          for (int64_t u = 0; u < count; ++u)
            for (int64_t j = 0; j < side; ++j) move(base + u * stride + j, j * count + u);
        };
        each([&](int64_t there, int64_t here) {
          square[here] = a.square[there];
          if (named) source[here] = a.source[there];
        });
        for (int64_t j = 0; j < side; ++j)
          envelope_along(int(count), 1, square + j * count, named ? source + j * count : nullptr,
                         stack + j * count, next + j * count,
                         named ? named_next + j * count : nullptr);
        each([&](int64_t there, int64_t here) {
          a.next_square[there] = next[here];
          if (named) a.next_source[there] = named_next[here];
        });
      }
    });
  }

  template <typename T>
  static void trilinear(const TrilinearArgs<T>& a, const Scope&) {
    parallel_for(a.count, 2048, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) gsf::trilinear(a, i);
    });
  }

  static void value_noise(const ValueNoiseArgs& a, const Scope&) {
    parallel_for(a.count, 512, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) gsf::value_noise(a, i);
    });
  }

  static void hashes(const HashesArgs& a, const Scope&) {
    parallel_for(a.count * a.turns, 8192, [&](int64_t begin, int64_t end) {
      for (int64_t k = begin; k < end; ++k) hash_one(a, k);
    });
  }

  static void label_boxes(const LabelBoxesArgs& a, const Scope&) {
    for (int64_t k = 0; k < 6 * a.count; ++k) a.box[k] = a.none(k);
    const int16_t* label = a.labels;
    for (int32_t x = 0; x < a.shape[0]; ++x)
      for (int32_t y = 0; y < a.shape[1]; ++y)
        for (int32_t z = 0; z < a.shape[2]; ++z, ++label) {
          if (*label < 0 || *label >= a.count) continue;
          int32_t* box = a.box + 6 * *label;
          const int32_t place[3] = {x, y, z};
          for (int axis = 0; axis < 3; ++axis) {
            box[2 * axis] = std::min(box[2 * axis], place[axis]);
            box[2 * axis + 1] = std::max(box[2 * axis + 1], place[axis]);
          }
        }
  }

  static void margin_counts(const MarginCountsArgs& a, const Scope&) {
    for (int64_t i = 0; i < a.count; ++i)
      gsf::margin_counts(a, i, [&](int64_t k) { ++a.found[k]; });
  }
};

}  // namespace
}  // namespace gsf

GSF_REGISTER(CPU, gsf::SpatialOps<gsf::SpatialCpu>)
