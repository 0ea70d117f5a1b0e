// Questions about labels of voxels and what is drawn by chance for them: hashes, boxes, and how
// many voxels the labels have when constants are added to their fields. Whole numbers, or one
// rounding each, so that both back ends give the same bits.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/host_device.h"

namespace gsf {

constexpr int kMostTurns = 64;

struct HashesArgs {
  int64_t count;  // N
  int turns;      // T
  const int64_t* seed;
  uint32_t salt[kMostTurns];
  double* values;  // [N, T]
};

// Uniform in -1 to 1.
GSF_INLINE void hash_one(const HashesArgs& a, int64_t k) {
  uint32_t h = uint32_t(uint64_t(a.seed[k / a.turns])) ^ a.salt[k % a.turns];
  h = (h ^ (h >> 16)) * 0x7FEB352Du;
  h = (h ^ (h >> 16)) * 0x846CA68Bu;
  h = h ^ (h >> 16);
  a.values[k] = double(h) * (2.0 / 4294967296.0) - 1.0;
}

struct LabelBoxesArgs {
  int64_t shape[3];
  int64_t count;          // labels
  const int16_t* labels;  // [X, Y, Z]
  int32_t* box;           // [count, 6] first and last index along x, y and z

  GSF_HOST_DEVICE int64_t voxels() const { return shape[0] * shape[1] * shape[2]; }
  // Of no voxel.
  GSF_HOST_DEVICE int32_t none(int64_t k) const {
    return k % 2 == 0 ? int32_t(shape[k % 6 / 2]) : -1;
  }
};

struct MarginCountsArgs {
  int64_t count;         // pairs
  int64_t labels;        // F
  const float* lead;     // [count] by how much the first field leads
  const int64_t* first;  // [count]
  const int64_t* second;
  const double* offset;  // [F] constants
  double width;          // of the band about a face
  int64_t* found;        // [2, F] voxels that a label has, and that are in the band of its faces
};

// Calls tell(index into found) for what pair i counts for.
template <typename Tell>
GSF_INLINE void margin_counts(const MarginCountsArgs& a, int64_t i, const Tell& tell) {
  const int64_t first = a.first[i], second = a.second[i];
  if (first < 0 || first >= a.labels || second < 0 || second >= a.labels) return;
  const double now = double(a.lead[i]) + (a.offset[first] - a.offset[second]);
  if (now >= 0.0) tell(first);
  if (now < 0.0) tell(second);
  if (std::abs(now) < a.width) {
    tell(a.labels + first);
    tell(a.labels + second);
  }
}

}  // namespace gsf
