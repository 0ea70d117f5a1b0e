// What a training changes and what the rasterizer takes: logarithms of scales, logits of opacities
// and two parts of the harmonics become a splat; gradients and penalties go back. And the rules of
// shape between two steps: no needles, nothing beyond the hull.
#pragma once

#include <cmath>

#include "core/raster/splat.h"
#include "core/spatial.h"

namespace gsf {

// --- there ---

template <typename T>
struct ActivationArgs {
  int64_t count;     // N
  int columns;       // of the raw scales: 3, or 1 for all axes
  int rest;          // coefficients in sh_rest
  int coefficients;  // of the harmonics in use, 1 + at most rest
  const T *scales, *opacities, *sh0, *sh_rest;
  T *out_scales, *out_opacities, *out_sh;

  GSF_HOST_DEVICE int64_t items() const { return count * coefficients * 3; }
};

// Item i: one value of the harmonics, and the shape of splat i where there is one.
template <typename T>
GSF_HOST_DEVICE void activate(const ActivationArgs<T>& a, int64_t i) {
  using std::exp;
  const int64_t width = 3 * a.coefficients, row = i / width, k = i - row * width;
  a.out_sh[i] = k < 3 ? a.sh0[3 * row + k] : a.sh_rest[3 * a.rest * row + k - 3];
  if (i >= a.count) return;
  for (int axis = 0; axis < 3; ++axis)
    a.out_scales[3 * i + axis] = exp(a.scales[a.columns == 3 ? 3 * i + axis : i]);
  a.out_opacities[i] = T(1) / (T(1) + exp(-a.opacities[i]));
}

// --- and back ---

template <typename T>
struct ActivationGradArgs {
  int64_t count;
  int columns, rest, coefficients;
  const T *scales, *opacities;                      // as activated
  const T *grad_scales, *grad_opacities, *grad_sh;  // with respect to these
  // Weights in the loss of one splat's scale (each axis), of longest / middle axis over `aspect`,
  // and of its opacity.
  T size, needle, aspect, opacity;
  T *out_scales, *out_opacities, *out_sh0, *out_rest;
  T* mark;  // becomes NaN where a splat has no finite shape; may be null

  GSF_HOST_DEVICE int64_t items() const { return count * (1 + rest) * 3; }
};

// Axes by length: the first of equal ones counts as the longer.
template <typename T>
GSF_HOST_DEVICE void by_length(const T* x, int* longest, int* middle) {
  int at[3] = {0, 1, 2};
  const auto order = [&](int i, int j) {
    if (!(x[at[j]] > x[at[i]])) return;
    const int other = at[i];
    at[i] = at[j];
    at[j] = other;
  };
  order(0, 1);
  order(1, 2);
  order(0, 1);
  *longest = at[0];
  *middle = at[1];
}

constexpr double kLeastAxis = 1e-9;  // below it no ratio is taken

template <typename T>
GSF_HOST_DEVICE void activate_backward(const ActivationGradArgs<T>& a, int64_t i) {
  const int64_t width = 3 * (1 + a.rest), row = i / width, k = i - row * width;
  const int64_t used = 3 * a.coefficients;
  const T slope = k < used ? a.grad_sh[used * row + k] : T(0);
  if (k < 3)
    a.out_sh0[3 * row + k] = slope;
  else
    a.out_rest[3 * a.rest * row + k - 3] = slope;
  if (i >= a.count) return;
  const T* s = a.scales + 3 * i;
  const T opacity = a.opacities[i];
  T g[3];
  for (int axis = 0; axis < 3; ++axis) g[axis] = a.grad_scales[3 * i + axis] + a.size;
  if (a.columns == 3 && a.needle != T(0)) {
    int longest, middle;
    by_length(s, &longest, &middle);
    const T low = T(kLeastAxis), base = s[middle] > low ? s[middle] : low;
    if (s[longest] > a.aspect * base) {
      g[longest] += a.needle / base;
      if (s[middle] > low) g[middle] -= a.needle * s[longest] / (base * base);
    }
  }
  if (a.columns == 3)
    for (int axis = 0; axis < 3; ++axis) a.out_scales[3 * i + axis] = g[axis] * s[axis];
  else
    a.out_scales[i] = (g[0] + g[1] + g[2]) * s[0];
  a.out_opacities[i] = (a.grad_opacities[i] + a.opacity) * opacity * (T(1) - opacity);
  // several threads may write here, all of them the same
  const T sum = s[0] + s[1] + s[2] + opacity;
  if (a.mark != nullptr && !finite(sum)) *a.mark = sum - sum;
}

// --- shape ---

template <typename T>
struct AspectArgs {
  int64_t count;
  T* scales;  // logarithms [N, 3]
  T most;     // logarithm of the longest over the middle axis
};

template <typename T>
GSF_HOST_DEVICE void clamp_aspect(const AspectArgs<T>& a, int64_t i) {
  T* s = a.scales + 3 * i;
  int longest, middle;
  by_length(s, &longest, &middle);
  const T limit = s[middle] + a.most;
  if (s[longest] > limit) s[longest] = limit;
}

// Opacity at which a Gaussian ends for the eye; what an axis keeps of its length when it is cut; of
// the interval in which the cut lies.
constexpr double kSeen = 0.02, kLeastShare = 0.02;
constexpr double kSlack = 1e-3;  // of the overhang
constexpr int kHalvings = 8;

// `away` holds distances from a body [voxels] at the points of a grid whose first lies at `origin`.
template <typename T>
struct ShortenArgs {
  int64_t count;
  const T *means, *quats, *scales, *opacities;  // as activated
  int64_t shape[3];
  const T* away;
  T origin[3], voxel, overhang;
  T* share;  // [N, 3]

  // How far a place lies outside; off the grid the distance to the grid is added.
  GSF_HOST_DEVICE T beyond(const T* place) const {
    using std::sqrt;
    T held[3], off = T(0);
    for (int axis = 0; axis < 3; ++axis) {
      const T at = (place[axis] - origin[axis]) / voxel, most = T(shape[axis] - 1);
      held[axis] = at < T(0) ? T(0) : at > most ? most : at;
      off += (at - held[axis]) * (at - held[axis]);
    }
    return (trilinear_at(shape, away, held) + sqrt(off)) * voxel;
  }
};

// Item i: one axis of a splat. The share of it that ends at most `overhang` beyond the body.
template <typename T>
GSF_HOST_DEVICE void shorten_axes(const ShortenArgs<T>& a, int64_t i) {
  using std::log;
  using std::sqrt;
  const int64_t row = i / 3;
  const int axis = int(i - 3 * row);
  const T seen = T(kSeen), opacity = a.opacities[row] > seen ? a.opacities[row] : seen;
  const T length = a.scales[i] * sqrt(T(2) * log(opacity / seen));
  Mat3<T> axes;
  const bool turned = rotation_from_quat(a.quats + 4 * row, &axes);
  T arm[3];
  for (int c = 0; c < 3; ++c)
    arm[c] = turned ? axes.m[3 * c + axis] * length : c == axis ? length : T(0);
  const auto fits = [&](T share, T overhang) {
    for (int end = -1; end <= 1; end += 2) {
      T tip[3];
      for (int c = 0; c < 3; ++c) tip[c] = a.means[3 * row + c] + T(end) * share * arm[c];
      if (!(a.beyond(tip) <= overhang)) return false;
    }
    return true;
  };
  T low = T(1);
  // what was cut once fits, whatever rounding does to it
  if (!fits(T(1), a.overhang * T(1 + kSlack))) {
    T high = T(1);
    low = T(0);
    for (int k = 0; k < kHalvings; ++k) {
      const T middle = T(0.5) * (low + high);
      (fits(middle, a.overhang) ? low : high) = middle;
    }
    if (low < T(kLeastShare)) low = T(kLeastShare);
  }
  a.share[i] = low;
}

}  // namespace gsf
