// The nearest points of places: by cells that a table finds by their hash, with cells four times as
// wide for the places that have not found enough. Its use: gsfluent/spatial/neighbours.py.
//
// Squared distances are rounded one operation at a time, so that both back ends find the same; of
// points as near the lower row comes first, so that the order within a cell does not matter.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

#include "core/spatial.h"

namespace gsf {

constexpr int kNearestRings = 2;        // cells to each side that a level looks at
constexpr int kNearestLevels = 64;      // each with cells four times as wide as the one before
constexpr double kCellLimit = 1 << 24;  // indices of cells stay below: their rounding is known
constexpr double kCellSlack = 1e-6;     // of a cell, more than that rounding

struct NearestArgs {
  int64_t points, queries, wanted;  // N, M, neighbours of each query
  int64_t buckets;                  // of the table, a power of two
  const double *point, *query;      // [N, 3], [M, 3]
  const int64_t *group, *asked;     // [N], [M]; null: all are of one
  double cell, reach;
  int64_t* box;              // [6] ends of all points, as `ordered`
  int32_t *count, *end;      // [buckets] points of each, and where its places end
  int32_t* row;              // [N] rows by bucket
  unsigned long long* left;  // [kNearestLevels] queries that a level leaves, and
  unsigned long long* used;  // [kNearestLevels] places that it has given
  uint8_t* done;             // [M]
  double* distance;          // [M, wanted], infinite where there are too few
  int64_t* index;            // [M, wanted], -1 there
};

// Doubles as whole numbers in the same order.
GSF_INLINE int64_t ordered(double value) {
  int64_t bits;
  std::memcpy(&bits, &value, sizeof bits);
  return bits < 0 ? bits ^ INT64_MAX : bits;
}

GSF_INLINE double unordered(int64_t bits) {
  if (bits < 0) bits ^= INT64_MAX;
  double value;
  std::memcpy(&value, &bits, sizeof value);
  return value;
}

GSF_INLINE bool finite_place(const double* x) {
  return std::isfinite(x[0]) && std::isfinite(x[1]) && std::isfinite(x[2]);
}

// Edge of the cells of a level; the least of them holds the index of every point.
GSF_INLINE double level_cell(const NearestArgs& a, int level) {
  double most = 0.0;
  for (int k = 0; k < 6; ++k) most = fmax(most, fabs(unordered(a.box[k])));
  const double least = most / (0.5 * kCellLimit);
  double cell = a.cell > least ? a.cell : least;
  for (int k = 0; k < level; ++k) cell *= 4.0;
  return cell;
}

// The cell of a place; false where its index is too large.
GSF_INLINE bool cell_at(const double* x, double cell, int64_t* index) {
  for (int axis = 0; axis < 3; ++axis) {
    const double place = floor(x[axis] / cell);
    if (!(fabs(place) < kCellLimit)) return false;
    index[axis] = int64_t(place);
  }
  return true;
}

GSF_INLINE int64_t group_of(const int64_t* group, int64_t i) { return group ? group[i] : 0; }

GSF_INLINE int64_t bucket_of(const NearestArgs& a, const int64_t* cell, int64_t group) {
  uint64_t h = uint64_t(group) * 0x9E3779B97F4A7C15ull;
  for (int axis = 0; axis < 3; ++axis) {
    h = (h ^ uint64_t(cell[axis])) * 0xBF58476D1CE4E5B9ull;
    h ^= h >> 29;
  }
  h *= 0x94D049BB133111EBull;
  h ^= h >> 32;
  return int64_t(h & uint64_t(a.buckets - 1));
}

// Bucket of point i; -1 where it is nowhere.
GSF_INLINE int64_t bucket_of_point(const NearestArgs& a, int64_t i, double cell) {
  int64_t index[3];
  if (!cell_at(a.point + 3 * i, cell, index)) return -1;
  return bucket_of(a, index, group_of(a.group, i));
}

// A cell of those around a query, numbered 0 to (2 ring + 1)^3 - 1; false unless it is of the ring.
GSF_INLINE bool cell_of_ring(const int64_t* middle, int ring, int number, int64_t* cell) {
  const int side = 2 * ring + 1;
  const int step[3] = {number / (side * side) - ring, number / side % side - ring,
                       number % side - ring};
  int far = 0;
  for (int axis = 0; axis < 3; ++axis) {
    cell[axis] = middle[axis] + step[axis];
    far = max(far, step[axis] < 0 ? -step[axis] : step[axis]);
  }
  return far == ring;
}

// At most the squared distance of a place from a cell.
GSF_INLINE double square_to_cell(const double* x, const int64_t* index, double cell) {
  double square = 0.0;
  for (int axis = 0; axis < 3; ++axis) {
    const double low = double(index[axis]) * cell, slack = kCellSlack * cell;
    const double off = fmax(low - x[axis], x[axis] - (low + cell)) - slack;
    if (off > 0.0) square += off * off;
  }
  return square;
}

GSF_INLINE bool nearer(double away, int64_t row, double worst, int64_t last) {
  return away < worst || (away == worst && row < last);
}

// Squared distance of a point from query i; false unless it is nearer than the worst and of the
// cell and the group that are asked.
GSF_INLINE bool candidate(const NearestArgs& a, int64_t i, int64_t row, const int64_t* cell,
                          double edge, double worst, int64_t last, double* away) {
  const double *p = a.point + 3 * row, *q = a.query + 3 * i;
  const double dx = p[0] - q[0], dy = p[1] - q[1], dz = p[2] - q[2];
  *away = (product(dx, dx) + product(dy, dy)) + product(dz, dz);
  if (!nearer(*away, row, worst, last)) return false;
  int64_t its[3];
  return cell_at(p, edge, its) && its[0] == cell[0] && its[1] == cell[1] && its[2] == cell[2] &&
         group_of(a.group, row) == group_of(a.asked, i);
}

// The list of a query: ascending; of those as near the lower row first. Squares until it is done.
struct NearestList {
  int64_t wanted;
  double* square;
  int64_t* index;

  GSF_HOST_DEVICE NearestList(const NearestArgs& a, int64_t i)
      : wanted(a.wanted), square(a.distance + a.wanted * i), index(a.index + a.wanted * i) {}
  GSF_HOST_DEVICE void clear() const {
    for (int64_t k = 0; k < wanted; ++k) {
      square[k] = HUGE_VAL;
      index[k] = -1;
    }
  }
  GSF_HOST_DEVICE void take(int64_t row, double away) const {
    int64_t at = wanted - 1;
    for (; at > 0; --at) {
      const double before = square[at - 1];
      if (before < away || (before == away && index[at - 1] < row)) break;
      square[at] = before;
      index[at] = index[at - 1];
    }
    square[at] = away;
    index[at] = row;
  }
  GSF_HOST_DEVICE void finish(double reach) const {
    for (int64_t k = 0; k < wanted; ++k) {
      square[k] = sqrt(square[k]);
      if (square[k] <= reach && index[k] >= 0) continue;
      square[k] = HUGE_VAL;
      index[k] = -1;
    }
  }
};

// Whether nothing nearer than the worst of a full list can be left when all points within `seen` of
// query i have been asked.
GSF_INLINE bool settled(const NearestArgs& a, int64_t i, double worst, double seen) {
  if (worst <= seen * seen || seen >= a.reach) return true;
  double far = 0.0;  // of the corner of all points that is farthest
  for (int axis = 0; axis < 3; ++axis) {
    const double q = a.query[3 * i + axis];
    const double low = unordered(a.box[axis]), high = unordered(a.box[axis + 3]);
    if (low > high) return true;  // there is no point
    const double way = fmax(fabs(q - low), fabs(high - q));
    far += way * way;
  }
  return far <= seen * seen;
}

}  // namespace gsf
