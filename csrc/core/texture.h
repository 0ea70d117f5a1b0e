// Steps of a texture's synthesis that torch takes one small operation at a time: quantiles of many
// distributions, how far values move from some to others, and votes of patches for voxels. Their
// use: gsfluent/pipeline/texture/synthesis.
//
// Each number is rounded where torch, asked one operation at a time, rounds it.
#pragma once

#include "core/spatial.h"

namespace gsf {

#ifdef __CUDA_ARCH__
GSF_INLINE float quotient(float a, float b) { return __fdiv_rn(a, b); }
#else
GSF_INLINE float quotient(float a, float b) { return a / b; }
#endif

struct RowsBetweenArgs {
  int64_t parts, length, columns, knots;  // P, L, D, K
  const float* ordered;                   // [P, L, D]
  const int64_t *low, *high;              // [P, K]
  const float* share;                     // [P, K]
  float* out;                             // [P, K, D]

  GSF_HOST_DEVICE int64_t items() const { return parts * knots * columns; }
  // Rows that do not exist have no value.
  GSF_HOST_DEVICE float row(int64_t part, int64_t at, int64_t column) const {
    const bool there = at >= 0 && at < length;
    return there ? ordered[(part * length + at) * columns + column] : NAN;
  }
};

GSF_HOST_DEVICE void row_between(const RowsBetweenArgs& a, int64_t item) {
  const int64_t knot = item / a.columns, column = item % a.columns, part = knot / a.knots;
  const float share = a.share[knot];
  a.out[item] = product(a.row(part, a.low[knot], column), 1.0f - share) +
                product(a.row(part, a.high[knot], column), share);
}

struct QuantileShiftArgs {
  int64_t parts, length, columns, knots;  // P, L, D, K
  const float* values;                    // [P, L, D]
  const float *have, *want;               // [P, K, D]
  float* moves;                           // [P, L, D]

  GSF_HOST_DEVICE int64_t items() const { return parts * length * columns; }
  // Quantile `i` of a distribution. Equal ones (flat colour) would make the inverse ambiguous.
  GSF_HOST_DEVICE float knot(int64_t part, int64_t i, int64_t column) const {
    return have[(part * knots + i) * columns + column] + product(float(i), 1e-5f);
  }
  GSF_HOST_DEVICE float move(int64_t part, int64_t i, int64_t column) const {
    const int64_t at = (part * knots + i) * columns + column;
    return want[at] - have[at];
  }
};

// How far `value` moves: knot(i) are the quantiles, ascending, and move(i) how far each moves.
template <typename Knot, typename Move>
GSF_HOST_DEVICE float quantile_shift(float value, int64_t knots, const Knot& knot,
                                     const Move& move) {
  int64_t low = 0, high = knots;  // the first quantile that is not below the value
  while (low < high) {
    const int64_t middle = (low + high) / 2;
    if (knot(middle) >= value)
      high = middle;
    else
      low = middle + 1;
  }
  const int64_t right = low < 1 ? 1 : low > knots - 1 ? knots - 1 : low;
  const float first = knot(right - 1), last = knot(right);
  float share = quotient(value - first, last - first);
  share = share < 0.0f ? 0.0f : share > 1.0f ? 1.0f : share;
  const float before = move(right - 1), after = move(right);
  return before + product(share, after - before);
}

struct PatchVotesArgs {
  int64_t count, places, bank, voxels;  // n, K, B, V
  const int64_t* center;                // [n] voxels, no two alike
  const int64_t* offset;                // [K] from a patch's centre to its places
  const int64_t* best;                  // [n] patch of each
  const float* patches;                 // [B, K, 3]
  const float* weight;                  // [n]
  const float* falloff;                 // [K]
  float* total;                         // [V, 3] added to
  float* share;                         // [V] added to
  int32_t* row;                         // [V] scratch: which of the n has its centre there, or -1
};

// What the patch of row `i` says of the voxel at its place `k`. Patches that do not exist are mute.
GSF_HOST_DEVICE void patch_vote(const PatchVotesArgs& a, int64_t i, int64_t k, float* total,
                                float* share) {
  const int64_t patch = a.best[i];
  if (patch < 0 || patch >= a.bank) return;
  const float vote = product(a.weight[i], a.falloff[k]);
  const float* color = a.patches + (patch * a.places + k) * 3;
  for (int c = 0; c < 3; ++c) total[c] += product(color[c], vote);
  *share += vote;
}

}  // namespace gsf
