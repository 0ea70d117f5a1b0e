// Exact Euclidean distance transform of voxels, one axis after another: along a line the lower
// envelope of parabolas (Meijster, Roerdink and Hesselink 2000), in whole numbers throughout. Of
// empty voxels that are as near, the one with the lowest index wins, so that both back ends, and
// any number of threads, name the same.
#pragma once

#include <cstdint>

#include "core/host_device.h"

namespace gsf {

constexpr int32_t kFarSquare = 1 << 28;  // more than any squared distance in a grid that is taken
constexpr int64_t kMostAlong = 8192;     // voxels along an axis: 3 * 8192^2 < 2^28, a place < 2^15

struct DistanceArgs {
  int64_t shape[3];
  int axis;               // of this pass: 2, then 1, then 0
  const bool* occupied;   // [X, Y, Z]; asked by the first pass
  const int32_t* square;  // [X, Y, Z] of the pass before
  const int32_t* source;  // [X, Y, Z] flat index of the nearest; null where nobody asks
  int32_t* stack;         // [X, Y, Z], not by the first pass
  int32_t* next_square;   // [X, Y, Z]
  int32_t* next_source;   // as source

  GSF_HOST_DEVICE int64_t voxels() const { return shape[0] * shape[1] * shape[2]; }
  GSF_HOST_DEVICE int64_t stride() const {
    return axis == 0 ? shape[1] * shape[2] : axis == 1 ? shape[2] : 1;
  }
  // First voxel of a line along the axis.
  GSF_HOST_DEVICE int64_t first(int64_t line) const {
    if (axis == 0) return line;
    if (axis == 2) return line * shape[2];
    return line / shape[2] * (shape[1] * shape[2]) + line % shape[2];
  }
};

// The first pass, along z: the nearer of the last empty voxel and the next one.
GSF_INLINE void distances_along(const DistanceArgs& a, int64_t line) {
  const int64_t count = a.shape[2], base = line * count;
  int64_t low = -1;
  for (int64_t z = 0; z < count; ++z) {
    if (!a.occupied[base + z]) low = z;
    a.next_square[base + z] = int32_t(low);
  }
  int64_t high = -1;
  for (int64_t z = count - 1; z >= 0; --z) {
    low = a.next_square[base + z];
    if (low == z) high = z;
    const bool up = high >= 0 && (low < 0 || high - z < z - low);
    const int64_t at = up ? high : low, apart = at - z;
    a.next_square[base + z] = at < 0 ? kFarSquare : int32_t(apart * apart);
    if (a.next_source) a.next_source[base + z] = int32_t(base + (at < 0 ? z : at));
  }
}

// A later pass along one line of `count` voxels, `stride` apart in all arrays. `stack` holds the
// parabolas of the envelope: where one's middle is, and from which voxel on it is the lowest.
GSF_INLINE void envelope_along(int count, int64_t stride, const int32_t* square,
                               const int32_t* source, int32_t* stack, int32_t* next_square,
                               int32_t* next_source) {
  const auto height = [&](int x, int middle) {
    return (x - middle) * (x - middle) + square[middle * stride];
  };
  int top = -1;
  for (int u = 0; u < count; ++u) {
    int middle = 0;
    while (top >= 0) {
      const int32_t held = stack[top * stride];
      const int from = held & 0xffff;
      middle = held >> 16;
      // the earlier one keeps what is as high
      if (height(from, middle) <= height(from, u)) break;
      --top;
    }
    int from = 0;
    if (top >= 0) {
      const int rise = u * u - middle * middle + square[u * stride] - square[middle * stride];
      from = 1 + rise / (2 * (u - middle));
    }
    if (from < count) stack[++top * stride] = u << 16 | from;
  }
  for (int u = count - 1; u >= 0; --u) {
    const int32_t held = stack[top * stride];
    const int middle = held >> 16;
    next_square[u * stride] = height(u, middle);
    if (next_source) next_source[u * stride] = source[middle * stride];
    if (u == (held & 0xffff)) --top;
  }
}

}  // namespace gsf
