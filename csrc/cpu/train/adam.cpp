// CPU kernel of the optimiser step, eight floats at a time, over short stretches of rows: a stretch
// that takes part as a whole, or not at all, is the common case and costs no look at its rows.
#include "host/adam.h"

#include <algorithm>

#include "cpu/pack.h"

namespace gsf {
namespace {

using cpu::load_pack;
using cpu::Pack;
using cpu::store_pack;

// Values handed to a thread at least; values of a stretch unless one row is longer.
constexpr int64_t kGrainValues = 16384;
constexpr int64_t kStretchValues = 1024;
// Rows from this many values on are skipped one by one, shorter ones lane by lane.
constexpr int64_t kLongRow = 32;

template <typename T>
bool all_finite(const T* x, int64_t count) {
  constexpr int64_t kLanes = Pack<T>::kLanes;
  Pack<T> odd(0);  // x - x is NaN for infinities and NaN
  int64_t i = 0;
  for (; i + kLanes <= count; i += kLanes) {
    const Pack<T> v = load_pack(x + i);
    odd += v - v;
  }
  T rest = T(0);
  for (; i < count; ++i) rest += x[i] - x[i];
  for (int lane = 0; lane < kLanes; ++lane) rest += odd[lane];
  return rest == T(0);
}

// Values begin..end of a tensor, those with part[i - begin] > 0 when kPart. The tail runs through
// padded packs: the rounding of a value does not depend on what is done to its neighbours.
template <bool kPart, typename T>
void update_values(const AdamTensor<T>& t, int64_t begin, int64_t end, const T* part = nullptr) {
  constexpr int64_t kLanes = Pack<T>::kLanes;
  for (int64_t i = begin; i < end; i += kLanes) {
    const int64_t count = std::min(end - i, kLanes);
    T *value = t.value + i, *first = t.first + i, *second = t.second + i;
    const T* gradient = t.gradient + i;
    T spare[4][kLanes];
    if (count < kLanes) {
      const T* from[4] = {value, first, second, gradient};
      for (int q = 0; q < 4; ++q) {
        std::fill_n(spare[q], kLanes, T(0));
        std::copy_n(from[q], count, spare[q]);
      }
      value = spare[0], first = spare[1], second = spare[2], gradient = spare[3];
    }
    const Pack<T> old_v = load_pack(value), old_m = load_pack(first), old_s = load_pack(second);
    Pack<T> v = old_v, m = old_m, s = old_s;
    adam_update(t.rates, load_pack(gradient), m, s, v);
    if constexpr (kPart) {
      const auto takes_part = load_pack(part + i - begin) > Pack<T>(0);
      v = select(takes_part, v, old_v);
      m = select(takes_part, m, old_m);
      s = select(takes_part, s, old_s);
    }
    store_pack(value, v);
    store_pack(first, m);
    store_pack(second, s);
    if (count < kLanes) {
      T* to[3] = {t.value + i, t.first + i, t.second + i};
      for (int q = 0; q < 3; ++q) std::copy_n(spare[q], count, to[q]);
    }
  }
}

// Rows begin..end, at most kStretchValues values or one row.
template <typename T>
void update_stretch(const AdamTensor<T>& t, const AdamVisible& visible, int64_t begin,
                    int64_t end) {
  const int64_t columns = t.columns;
  const auto gradient = [&](int64_t r) { return t.gradient + r * columns; };
  int64_t chosen[kStretchValues];  // rows that take part
  int64_t count = 0;
  for (int64_t r = begin; r < end; ++r) {
    chosen[count] = r;
    count += visible(r);
  }
  if (count == 0) return;
  const bool all = count == end - begin;
  const bool clean =
      (all || columns < kLongRow) && all_finite(gradient(begin), (end - begin) * columns);
  if (all && clean) return update_values<false>(t, begin * columns, end * columns);
  if (columns >= kLongRow) {
    for (int64_t i = 0; i < count; ++i)
      if (all_finite(gradient(chosen[i]), columns))
        update_values<false>(t, chosen[i] * columns, (chosen[i] + 1) * columns);
    return;
  }
  T row_part[kStretchValues] = {};
  for (int64_t i = 0; i < count; ++i)
    row_part[chosen[i] - begin] = T(clean || all_finite(gradient(chosen[i]), columns));
  T part[kStretchValues + Pack<T>::kLanes];
  for (int64_t c = 0; c < columns; ++c)  // rows inside: they are many, and columns few
    for (int64_t r = 0; r < end - begin; ++r) part[r * columns + c] = row_part[r];
  std::fill_n(part + (end - begin) * columns, Pack<T>::kLanes, T(0));
  update_values<true>(t, begin * columns, end * columns, part);
}

struct AdamCpu {
  using Scope = CpuScope;
  template <typename T>
  static void adam_step(const AdamArgs<T>& args, const Scope&) {
    for (int k = 0; k < args.count; ++k) {
      const AdamTensor<T>& t = args.tensors[k];
      const int64_t rows = std::max<int64_t>(kStretchValues / t.columns, 1);
      const int64_t grain = std::max<int64_t>(kGrainValues / t.columns, 1);
      parallel_for(t.rows, grain, [&](int64_t begin, int64_t end) {
        for (int64_t r = begin; r < end; r += rows)
          update_stretch(t, args.visible, r, std::min(r + rows, end));
      });
    }
  }
};

}  // namespace
}  // namespace gsf

GSF_REGISTER(CPU, gsf::AdamOps<gsf::AdamCpu>)
