// One rectangle of SSIM and of the photometric loss on the CPU. Rows stream through: each image row
// is blurred along x into a ring of 11, a full ring gives a row of the map, whose slopes are
// blurred along x into a second ring, which when full gives a row of the gradient. The rings stay
// in the second-level cache, and nothing of the size of the image is held.
#pragma once

#include <algorithm>
#include <cmath>
#include <memory>
#include <utility>

#include "core/train/ssim.h"
#include "cpu/pack.h"

namespace gsf::ssim_cpu {

using cpu::load_pack;
using cpu::Pack;
using cpu::store_pack;

// Sums of one row of a rectangle.
using RowSums = double[kSsimSums];

template <typename T>
class Tile {
 public:
  // Rows r0..r1 and columns c0..c1 of the image; `sums` has one entry per row of the image.
  Tile(const SsimArgs<T>& a, int64_t r0, int64_t r1, int64_t c0, int64_t c1, RowSums* sums)
      : a_(a), ch_(a.channels), r0_(r0), r1_(r1), c0_(c0), c1_(c1), sums_(sums) {
    const bool gradient = a.grad_image != nullptr;
    const int64_t reach = gradient ? kSsimRadius : 0;
    top_ = std::max(r0 - reach, a.inset);
    bottom_ = std::min(r1 + reach, a.height - a.inset);
    left_ = std::max(c0 - reach, a.inset);
    right_ = std::min(c1 + reach, a.width - a.inset);
    if (top_ >= bottom_ || left_ >= right_) top_ = bottom_ = left_ = right_ = 0;
    span_ = (right_ - left_) * ch_;
    own_ = (c1 - c0) * ch_;
    // lanes past the end of a row are computed and never read
    pitch_ = std::max(span_, own_) + 2 * kSsimRadius * ch_ + 2 * kLanes;
    const int64_t rings = (4 + (gradient ? 3 : 0)) * kSsimWindow;
    arena_.reset(new T[static_cast<size_t>(pitch_ * (kLines + rings))]);
    std::fill_n(arena_.get(), pitch_ * kLines, T(0));  // the rings are written before they are read
    T* next = arena_.get();
    const auto take = [&](int64_t rows) { return std::exchange(next, next + rows * pitch_); };
    m_ = take(1);
    d_ = take(1);
    value_ = take(1);
    valid_ = take(1);
    shift_ = take(1);
    miss_ = take(1);
    slopes_ = take(3);
    moments_ = take(4 * kSsimWindow);
    if (gradient) spread_ = take(3 * kSsimWindow);
  }

  void run() {
    int64_t finished = r0_;
    for (int64_t row = top_ - kSsimRadius; row < bottom_ + kSsimRadius && top_ < bottom_; ++row) {
      load_row(row);
      blur_row(moments_ + 4 * pitch_ * slot(row));
      const int64_t i = row - kSsimRadius;
      if (i < top_) continue;
      similarity_row(i);
      if (spread_ == nullptr) continue;
      spread_row(spread_ + 3 * pitch_ * slot(i));
      for (; finished < r1_ && finished + kSsimRadius <= i; ++finished) finish_row(finished);
    }
    for (; finished < r1_; ++finished) finish_row(finished);
  }

 private:
  static constexpr int kLanes = Pack<T>::kLanes;
  static constexpr int64_t kLines = 9;  // single rows in the arena

  static int64_t slot(int64_t row) { return (row + kSsimWindow) % kSsimWindow; }

  // m and d of row `row` over the columns whose windows the map row needs.
  void load_row(int64_t row) {
    const int64_t first = left_ - kSsimRadius, last = right_ + kSsimRadius;
    const int64_t from = row < 0 || row >= a_.height ? last : std::max<int64_t>(first, 0);
    const int64_t to = row < 0 || row >= a_.height ? last : std::min(last, a_.width);
    std::fill(m_, m_ + (from - first) * ch_, T(kSsimOutside));
    std::fill(d_, d_ + (from - first) * ch_, T(0));
    std::fill(m_ + (to - first) * ch_, m_ + (last - first) * ch_, T(kSsimOutside));
    std::fill(d_ + (to - first) * ch_, d_ + (last - first) * ch_, T(0));
    if (from < to) load_pair(row, from, to, m_ + (from - first) * ch_, d_ + (from - first) * ch_);
  }

  void load_pair(int64_t row, int64_t from, int64_t to, T* m, T* d) {
    const int64_t start = row * a_.width + from, count = (to - from) * ch_;
    const T* x = a_.image + start * ch_;
    const T* y = a_.target + start * ch_;
    if (a_.valid != nullptr) {
      repeat(a_.valid + start, to - from, value_);
      for (int64_t i = 0; i < count; ++i) value_[i] *= x[i];
      x = value_;
    }
    for (int64_t i = 0; i < count; ++i) {
      m[i] = T(0.5) * (x[i] + y[i]) + T(kSsimOutside);
      d[i] = x[i] - y[i];
    }
  }

  // One value per pixel to one per channel of it.
  void repeat(const T* plane, int64_t count, T* out) const {
    for (int64_t p = 0; p < count; ++p)
      for (int64_t c = 0; c < ch_; ++c) out[p * ch_ + c] = plane[p];
  }

  // Window along x of m, d and their squares.
  void blur_row(T* out) const {
    for (int64_t i = 0; i < span_; i += kLanes) {
      Pack<T> m(0), d(0), mm(0), dd(0);
#pragma GCC unroll 11
      for (int k = 0; k < kSsimWindow; ++k) {
        const Pack<T> tap(ssim_tap<T>(k));
        const Pack<T> a = load_pack(m_ + i + k * ch_), b = load_pack(d_ + i + k * ch_);
        const Pack<T> wa = tap * a, wb = tap * b;
        m += wa;
        d += wb;
        mm += wa * a;
        dd += wb * b;
      }
      store_pack(out + i, m);
      store_pack(out + pitch_ + i, d);
      store_pack(out + 2 * pitch_ + i, mm);
      store_pack(out + 3 * pitch_ + i, dd);
    }
  }

  // Window along y of `kPlanes` planes that lie a pitch apart in each of the 11 rows.
  template <int kPlanes>
  void down(const T* const* rows, int64_t i, Pack<T>* out) const {
    for (int q = 0; q < kPlanes; ++q) out[q] = Pack<T>(0);
#pragma GCC unroll 11
    for (int k = 0; k < kSsimWindow; ++k) {
      const Pack<T> tap(ssim_tap<T>(k));
      for (int q = 0; q < kPlanes; ++q) out[q] += tap * load_pack(rows[k] + q * pitch_ + i);
    }
  }

  // Row i of the map, and its slopes times d loss / d map into slopes_.
  void similarity_row(int64_t i) {
    const T* rows[kSsimWindow];
    for (int k = 0; k < kSsimWindow; ++k)
      rows[k] = moments_ + 4 * pitch_ * slot(i - kSsimRadius + k);
    // the slopes lie where the blur along x expects them: from column c0 - 5
    const int64_t lead = spread_ == nullptr ? 0 : (left_ - (c0_ - kSsimRadius)) * ch_;
    const int64_t map_row = (i - a_.inset) * (a_.width - 2 * a_.inset) + left_ - a_.inset;
    const Pack<T> slope(a_.similarity_slope);
    for (int64_t j = 0; j < span_; j += kLanes) {
      Pack<T> w[4];
      down<4>(rows, j, w);
      SsimSlopes<Pack<T>> s;
      store_pack(value_ + j, ssim_value(SsimMoments<Pack<T>>{w[0], w[1], w[2], w[3]}, s));
      if (spread_ == nullptr) continue;
      Pack<T> g = slope;
      if (a_.map_slope != nullptr) g = load_part(a_.map_slope + map_row * ch_ + j, span_ - j);
      store_pack(slopes_ + lead + j, g * s.linear);
      store_pack(slopes_ + pitch_ + lead + j, g * s.square_m);
      store_pack(slopes_ + 2 * pitch_ + lead + j, g * s.square_d);
    }
    if (spread_ != nullptr)  // what the last pack left beyond the map
      for (int q = 0; q < 3; ++q) std::fill_n(slopes_ + q * pitch_ + lead + span_, kLanes, T(0));
    if (i < r0_ || i >= r1_) return;
    const int64_t from = std::max(left_, c0_), to = std::min(right_, c1_);
    if (from >= to) return;
    const T* mine = value_ + (from - left_) * ch_;
    const int64_t count = (to - from) * ch_;
    if (a_.map != nullptr) std::copy_n(mine, count, a_.map + (map_row + from - left_) * ch_);
    if (a_.loss != nullptr) sums_[i][kSumSimilarity] = sum(mine, count, [](T x) { return x; });
  }

  static Pack<T> load_part(const T* p, int64_t count) {
    if (count >= kLanes) return load_pack(p);
    T part[kLanes] = {};
    std::copy_n(p, count, part);
    return load_pack(part);
  }

  // Adjoint window along x of the slopes: columns c0..c1.
  void spread_row(T* out) const {
    for (int64_t i = 0; i < own_; i += kLanes)
      for (int q = 0; q < 3; ++q) {
        Pack<T> total(0);
#pragma GCC unroll 11
        for (int k = 0; k < kSsimWindow; ++k)
          total += Pack<T>(ssim_tap<T>(k)) * load_pack(slopes_ + q * pitch_ + i + k * ch_);
        store_pack(out + q * pitch_ + i, total);
      }
  }

  // Gradient and pixel sums of row r.
  void finish_row(int64_t r) {
    if (spread_ == nullptr && !a_.pixels) return;
    const int64_t start = r * a_.width + c0_, columns = c1_ - c0_;
    if (spread_ != nullptr) {
      load_pair(r, c0_, c1_, m_, d_);
      const T* rows[kSsimWindow];
      for (int k = 0; k < kSsimWindow; ++k) {
        const int64_t i = r - kSsimRadius + k;
        rows[k] = i < top_ || i >= bottom_ ? nullptr : spread_ + 3 * pitch_ * slot(i);
      }
      spread_down(rows);
    }
    if (!a_.pixels && a_.valid == nullptr) {
      std::copy_n(value_, own_, a_.grad_image + start * ch_);
      return;
    }
    if (a_.valid != nullptr) repeat(a_.valid + start, columns, valid_);
    if (a_.pixels) pixel_row(r, start, columns);
    if (spread_ == nullptr) return;
    T* gradient = a_.grad_image + start * ch_;
    if (a_.pixels) {
      const T slope = a_.miss_slope;
      for (int64_t i = 0; i < own_; ++i) value_[i] += slope * sign_of(miss_[i]);
    }
    if (a_.valid != nullptr)
      for (int64_t i = 0; i < own_; ++i) value_[i] *= valid_[i];
    std::copy_n(value_, own_, gradient);
  }

  // Gradient of the similarity into value_.
  void spread_down(const T* const* rows) {
    for (int64_t i = 0; i < own_; i += kLanes) {
      Pack<T> w[3] = {Pack<T>(0), Pack<T>(0), Pack<T>(0)};
      for (int k = 0; k < kSsimWindow; ++k) {
        if (rows[k] == nullptr) continue;
        const Pack<T> tap(ssim_tap<T>(k));
        for (int q = 0; q < 3; ++q) w[q] += tap * load_pack(rows[k] + q * pitch_ + i);
      }
      store_pack(value_ + i, w[0] + load_pack(m_ + i) * w[1] + load_pack(d_ + i) * w[2]);
    }
  }

  // miss_ of row r, its sums, and the gradient of alpha.
  void pixel_row(int64_t r, int64_t start, int64_t columns) {
    const T* x = a_.image + start * ch_;
    const T* y = a_.target + start * ch_;
    if (a_.valid != nullptr) {
      for (int64_t i = 0; i < own_; ++i) miss_[i] = valid_[i] * x[i] - y[i];
    } else {
      for (int64_t i = 0; i < own_; ++i) miss_[i] = x[i] - y[i];
    }
    if (a_.alpha != nullptr) {
      for (int64_t p = 0; p < columns; ++p) shift_[p] = ssim_excess(a_, start + p);
      sums_[r][kSumExcess] += sum(shift_, columns, [](T v) { return std::abs(v); });
      if (a_.backdrop != nullptr)
        for (int64_t p = 0; p < columns; ++p)
          for (int64_t c = 0; c < ch_; ++c) miss_[p * ch_ + c] -= shift_[p] * a_.backdrop[c];
      if (a_.grad_alpha != nullptr)
        for (int64_t p = 0; p < columns; ++p)
          a_.grad_alpha[start + p] = ssim_alpha_slope(a_, start + p, shift_[p]);
    }
    sums_[r][kSumAbsolute] = sum(miss_, own_, [](T v) { return std::abs(v); });
    sums_[r][kSumSquare] = sum(miss_, own_, [](T v) { return v * v; });
  }

  // Sum of f(x) in double, in an order that depends on the count alone.
  template <typename F>
  static double sum(const T* x, int64_t count, const F& f) {
    double lanes[8] = {};
    int64_t i = 0;
    for (; i + 8 <= count; i += 8)
      for (int k = 0; k < 8; ++k) lanes[k] += static_cast<double>(f(x[i + k]));
    for (int k = 0; i + k < count; ++k) lanes[k] += static_cast<double>(f(x[i + k]));
    return ((lanes[0] + lanes[4]) + (lanes[1] + lanes[5])) +
           ((lanes[2] + lanes[6]) + (lanes[3] + lanes[7]));
  }

  const SsimArgs<T>& a_;
  int64_t ch_, r0_, r1_, c0_, c1_;
  RowSums* sums_;
  int64_t top_, bottom_, left_, right_;  // of the map that the tile reads, in pixels of the image
  int64_t span_, own_, pitch_;           // values of a map row, of a row of the tile, of a buffer
  std::unique_ptr<T[]> arena_;
  T *m_, *d_, *value_, *valid_, *shift_, *miss_, *slopes_, *moments_;
  T* spread_ = nullptr;
};

}  // namespace gsf::ssim_cpu
