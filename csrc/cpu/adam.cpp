// CPU kernel of the optimiser step: runs of rows that take part, eight floats at a time.
#include "host/adam.h"

#include <algorithm>

#include "cpu/pack.h"

namespace gsf {
namespace {

using cpu::load_pack;
using cpu::Pack;
using cpu::store_pack;

// Values handed to a thread at least.
constexpr int64_t kGrainValues = 16384;

template <typename T>
bool row_is_finite(const T* gradient, int64_t count) {
  T excess = T(0);  // x - x is NaN for infinities and NaN
  for (int64_t i = 0; i < count; ++i) excess += gradient[i] - gradient[i];
  return excess == T(0);
}

// Values begin..end of a tensor. The tail runs through a padded pack, so that a value's rounding
// does not depend on its neighbours.
template <typename T>
void update_values(const AdamTensor<T>& t, int64_t begin, int64_t end) {
  constexpr int64_t kLanes = Pack<T>::kLanes;
  for (int64_t i = begin; i < end; i += kLanes) {
    const int64_t count = std::min(end - i, kLanes);
    T *value = t.value + i, *first = t.first + i, *second = t.second + i;
    const T* gradient = t.gradient + i;
    T spare[4][kLanes];
    if (count < kLanes) {
      std::fill_n(spare[0], 4 * kLanes, T(0));
      const T* from[4] = {value, first, second, gradient};
      for (int q = 0; q < 4; ++q) std::copy_n(from[q], count, spare[q]);
      value = spare[0], first = spare[1], second = spare[2], gradient = spare[3];
    }
    Pack<T> v = load_pack(value), m = load_pack(first), s = load_pack(second);
    adam_update(t.rates, load_pack(gradient), m, s, v);
    store_pack(value, v);
    store_pack(first, m);
    store_pack(second, s);
    if (count < kLanes) {
      T* to[3] = {t.value + i, t.first + i, t.second + i};
      for (int q = 0; q < 3; ++q) std::copy_n(spare[q], count, to[q]);
    }
  }
}

struct AdamCpu {
  template <typename T>
  static void step(const AdamArgs<T>& args, const Tensor&) {
    for (int k = 0; k < args.count; ++k) {
      const AdamTensor<T>& t = args.tensors[k];
      const int64_t grain = std::max<int64_t>(kGrainValues / t.columns, 1);
      parallel_for(t.rows, grain, [&](int64_t begin, int64_t end) {
        int64_t run = begin;  // first row of those that wait for their update
        for (int64_t row = begin; row < end; ++row) {
          if (args.visible(row) && row_is_finite(t.gradient + row * t.columns, t.columns)) continue;
          update_values(t, run * t.columns, row * t.columns);
          run = row + 1;
        }
        update_values(t, run * t.columns, end * t.columns);
      });
    }
  }
};

}  // namespace
}  // namespace gsf

STABLE_TORCH_LIBRARY_IMPL(gsfluent, CPU, m) {
  m.impl("adam_step", TORCH_BOX(&gsf::AdamOps<gsf::AdamCpu>::step));
}
