// Structural similarity (Wang et al. 2004, equation 13) at one place from windowed means, its
// slopes, and the arguments of the image losses.
//
// With m = (x + y) / 2 - 1/2 and d = x - y, and M, D, Vm, Vd their windowed means and variances,
//   mu_x^2 + mu_y^2       = 2 (M + 1/2)^2 + D^2 / 2 = A - C1,   2 mu_x mu_y = A - C1 - D^2
//   sigma_x^2 + sigma_y^2 = 2 Vm + Vd / 2           = B - C2,   2 sigma_xy  = B - C2 - Vd
// so that ssim = (1 - D^2 / A) (1 - Vd / B): four windowed means instead of five, exactly 1 for
// equal images, exactly symmetric, and without the cancellation of 2 sigma_xy against
// sigma_x^2 + sigma_y^2 that costs float32 four digits where the images are alike.
#pragma once

#include "core/vec.h"

namespace gsf {

constexpr int kSsimWindow = 11;
constexpr int kSsimRadius = 5;

// exp(-k^2 / (2 * 1.5^2)) over its sum for |k| <= 5, k = tap - 5.
template <typename T>
GSF_HOST_DEVICE T ssim_tap(int tap) {
  const int k = tap < kSsimRadius ? kSsimRadius - tap : tap - kSsimRadius;
  return T(k == 0   ? 0.26601172486179436
           : k == 1 ? 0.2130055377112537
           : k == 2 ? 0.10936068950970002
           : k == 3 ? 0.03600077212843083
           : k == 4 ? 0.007598758135239185
                    : 0.00102838008447911);
}

// m of a place outside the image, where both images count as 0.
constexpr double kSsimOutside = -0.5;

// Windowed means of m, d, m^2, d^2; T may be a pack of lanes.
template <typename T>
struct SsimMoments {
  T m, d, mm, dd;
};

// What the adjoint blurs: the gradient with respect to x is
// W^T[linear] + m W^T[square_m] + d W^T[square_d].
template <typename T>
struct SsimSlopes {
  T linear, square_m, square_d;
};

template <typename T>
GSF_HOST_DEVICE T ssim_value(const SsimMoments<T>& w, SsimSlopes<T>& slopes) {
  const T zero(0.0), half(0.5), two(2.0);
  const T mean = w.m + half;
  // rounding may leave a variance of a flat window just below zero
  const T var_m = max(w.mm - w.m * w.m, zero);
  const T var_d = max(w.dd - w.d * w.d, zero);
  const T inv_a = T(1.0) / (two * mean * mean + half * (w.d * w.d) + T(0.01 * 0.01));
  const T inv_b = T(1.0) / (two * var_m + half * var_d + T(0.03 * 0.03));
  const T apart = w.d * w.d * inv_a;  // 1 - luminance
  const T unlike = var_d * inv_b;     // 1 - contrast times structure
  const T luminance = T(1.0) - apart, structure = T(1.0) - unlike;
  const T to_mm = luminance * (two * unlike * inv_b);
  const T to_dd = luminance * (inv_b * (half * unlike - T(1.0)));
  const T to_m = structure * (T(4.0) * mean * apart * inv_a) - two * w.m * to_mm;
  const T to_d = structure * (w.d * inv_a * (apart - two)) - two * w.d * to_dd;
  // dm/dx = 1/2, dd/dx = 1
  slopes = {half * to_m + to_d, to_mm, two * to_dd};
  return luminance * structure;
}

// Sums over the image behind the figures of a loss.
enum SsimSum : int { kSumSimilarity, kSumAbsolute, kSumSquare, kSumExcess, kSsimSums };

// loss = constant + l1 mean|miss| + ssim mean(similarity) + excess mean|excess|, with
// x = valid image, excess = valid alpha - mask, miss = x - target - excess backdrop.
struct SsimWeights {
  double constant, l1, ssim, excess;
};

template <typename T>
struct SsimArgs {
  int64_t height, width, channels;
  int64_t inset;            // of the map on every side: 5 inside the image, 0 with zeros around it
  const T *image, *target;  // [H, W, C]
  const T *valid, *alpha, *mask, *backdrop;  // [H, W] x 3, [C]; null: 1, none, none, 0
  const T* map_slope;  // d loss / d map, [H - 2 inset, W - 2 inset, C]; null: `weights`
  SsimWeights weights;
  bool pixels;                 // sums of |miss|, miss^2, |excess| are wanted
  T* map;                      // [H - 2 inset, W - 2 inset, C] or null
  T *grad_image, *grad_alpha;  // [H, W, C], [H, W] or null
  T *loss, *figures;           // [], [kSsimSums] or null

  // Slopes of the loss to one term of each mean, see weigh().
  T similarity_slope, miss_slope, excess_slope;

  GSF_HOST_DEVICE int64_t map_count() const {
    return (height - 2 * inset) * (width - 2 * inset) * channels;
  }
  void weigh(const SsimWeights& w) {
    weights = w;
    similarity_slope = T(w.ssim / double(map_count()));
    miss_slope = T(w.l1 / double(height * width * channels));
    excess_slope = T(w.excess / double(height * width));
  }
};

template <typename T>
GSF_HOST_DEVICE T sign_of(T x) {
  return T((x > T(0)) - (x < T(0)));
}

// Valid alpha minus mask of pixel p; 0 without alpha.
template <typename T>
GSF_HOST_DEVICE T ssim_excess(const SsimArgs<T>& a, int64_t p) {
  if (a.alpha == nullptr) return T(0);
  return (a.valid == nullptr ? a.alpha[p] : a.valid[p] * a.alpha[p]) - a.mask[p];
}

// x - y - excess backdrop of channel c.
template <typename T>
GSF_HOST_DEVICE T ssim_miss(const SsimArgs<T>& a, int64_t c, T x, T y, T excess) {
  return a.backdrop == nullptr ? x - y : x - y - excess * a.backdrop[c];
}

// d loss / d alpha of pixel p.
template <typename T>
GSF_HOST_DEVICE T ssim_alpha_slope(const SsimArgs<T>& a, int64_t p, T excess) {
  const T valid = a.valid == nullptr ? T(1) : a.valid[p];
  T slope = a.excess_slope * sign_of(excess);
  if (a.backdrop != nullptr)
    for (int64_t c = 0; c < a.channels; ++c) {
      const int64_t i = p * a.channels + c;
      const T miss = ssim_miss(a, c, valid * a.image[i], a.target[i], excess);
      slope -= a.miss_slope * a.backdrop[c] * sign_of(miss);
    }
  return valid * slope;
}

// Loss and the four means it is made of.
template <typename T>
GSF_HOST_DEVICE void ssim_finish(const SsimArgs<T>& a, const double* sums) {
  const double pixels = double(a.height * a.width), values = pixels * double(a.channels);
  const double similarity = sums[kSumSimilarity] / double(a.map_count());
  const double l1 = sums[kSumAbsolute] / values, excess = sums[kSumExcess] / pixels;
  const SsimWeights& w = a.weights;
  // a weight of zero must not turn an infinite mean into NaN
  double loss = w.constant + w.ssim * similarity;
  if (w.l1 != 0.0) loss += w.l1 * l1;
  if (w.excess != 0.0) loss += w.excess * excess;
  a.loss[0] = T(loss);
  a.figures[kSumSimilarity] = T(similarity);
  a.figures[kSumAbsolute] = T(l1);
  a.figures[kSumSquare] = T(sums[kSumSquare] / values);
  a.figures[kSumExcess] = T(excess);
}

}  // namespace gsf
