// One step of Adam (Kingma and Ba 2015, algorithm 1) for one value, and the arguments of a step
// over several tensors whose rows may be left out.
#pragma once

#include "core/vec.h"

namespace gsf {

template <typename T>
struct AdamRates {
  T rate;          // step size over 1 - beta1^t
  T take1, take2;  // 1 - beta1, 1 - beta2
  T keep2;         // beta2
  T root;          // 1 / sqrt(1 - beta2^t)
  T epsilon;
};

// S: the scalar, or a pack of lanes of it.
template <typename S, typename T>
GSF_HOST_DEVICE void adam_update(const AdamRates<T>& r, S gradient, S& first, S& second, S& value) {
  using std::sqrt;
  first = first + S(r.take1) * (gradient - first);
  second = S(r.keep2) * second + S(r.take2) * (gradient * gradient);
  value = value - S(r.rate) * (first / (sqrt(second) * S(r.root) + S(r.epsilon)));
}

// One tensor: `rows` rows of `columns` values each.
template <typename T>
struct AdamTensor {
  T *value, *first, *second;
  const T* gradient;
  int64_t rows, columns;
  AdamRates<T> rates;
};

// Which rows a step leaves out: those with visible[row] <= 0, and those with a gradient that is not
// finite. Both null: all rows are seen.
struct AdamVisible {
  const int32_t* radii;
  const uint8_t* flags;

  GSF_HOST_DEVICE bool operator()(int64_t row) const {
    if (radii != nullptr) return radii[row] > 0;
    return flags == nullptr || flags[row] != 0;
  }
};

constexpr int kAdamTensors = 8;  // per call of a back end

template <typename T>
struct AdamArgs {
  int count;
  AdamTensor<T> tensors[kAdamTensors];
  AdamVisible visible;
};

}  // namespace gsf
