// Everything gsfluent takes from torch: the stable ABI only (torch/csrc/stable, headeronly). No
// other header includes torch.
#pragma once

#include <torch/csrc/stable/accelerator.h>
#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/core/ScalarType.h>
#include <torch/headeronly/util/Exception.h>

#include <cstdint>
#include <initializer_list>
#include <optional>
#include <string>
#include <tuple>
#include <vector>

namespace gsf {

using Tensor = torch::stable::Tensor;
using OptTensor = std::optional<Tensor>;
using ScalarType = torch::headeronly::ScalarType;

template <typename T>
constexpr ScalarType scalar_type_of() {
  if constexpr (std::is_same_v<T, float>) return ScalarType::Float;
  if constexpr (std::is_same_v<T, double>) return ScalarType::Double;
  if constexpr (std::is_same_v<T, int32_t>) return ScalarType::Int;
  if constexpr (std::is_same_v<T, int64_t>) return ScalarType::Long;
  if constexpr (std::is_same_v<T, uint8_t>) return ScalarType::Byte;
}

inline std::string shape_string(const Tensor& t) {
  std::string s = "[";
  for (int64_t i = 0; i < t.dim(); ++i) s += (i ? ", " : "") + std::to_string(t.size(i));
  return s + "]";
}

// Second fence behind gsfluent/_check.py: expected sizes, -1 = any.
inline void check_shape(const char* op, const char* name, const Tensor& t,
                        const std::vector<int64_t>& expected) {
  bool ok = t.dim() == static_cast<int64_t>(expected.size());
  if (ok) {
    int64_t i = 0;
    for (int64_t e : expected) {
      ok = ok && (e < 0 || t.size(i) == e);
      ++i;
    }
  }
  std::string want = "[";
  for (int64_t e : expected)
    want += (want.size() > 1 ? ", " : "") + (e < 0 ? "*" : std::to_string(e));
  STD_TORCH_CHECK(ok, op, ": ", name, " must have shape ", want, "], got ", shape_string(t));
}

inline void check_dtype(const char* op, const char* name, const Tensor& t, ScalarType expected) {
  STD_TORCH_CHECK(t.scalar_type() == expected, op, ": ", name, " has the wrong dtype");
}

inline void check_same_device(const char* op, const char* name, const Tensor& t,
                              const Tensor& like) {
  STD_TORCH_CHECK(t.device() == like.device(), op, ": ", name,
                  " must be on the same device as the first tensor");
}

template <typename T>
const T* cptr(const Tensor& t) {
  return static_cast<const T*>(t.const_data_ptr());
}
template <typename T>
T* mptr(const Tensor& t) {
  return static_cast<T*>(t.mutable_data_ptr());
}

inline Tensor contiguous(const Tensor& t) {
  return t.is_contiguous() ? t : torch::stable::contiguous(t);
}

inline Tensor new_empty(const Tensor& like, const std::vector<int64_t>& sizes, ScalarType dtype) {
  return torch::stable::new_empty(
      like, torch::headeronly::IntHeaderOnlyArrayRef(sizes.data(), sizes.size()), dtype);
}
inline Tensor new_zeros(const Tensor& like, const std::vector<int64_t>& sizes, ScalarType dtype) {
  return torch::stable::new_zeros(
      like, torch::headeronly::IntHeaderOnlyArrayRef(sizes.data(), sizes.size()), dtype);
}

// Calls f.template operator()<float>() or <double>() by the dtype of `t`.
template <typename F>
decltype(auto) dispatch_floating(const char* op, const Tensor& t, F&& f) {
  if (t.scalar_type() == ScalarType::Double) return f.template operator()<double>();
  STD_TORCH_CHECK(t.scalar_type() == ScalarType::Float, op, ": expected float32 or float64");
  return f.template operator()<float>();
}

// Splits [0, n) over torch's CPU threads; `f(begin, end)`.
template <typename F>
void parallel_for(int64_t n, int64_t grain, const F& f) {
  if (n > 0) torch::stable::parallel_for(0, n, grain, f);
}

}  // namespace gsf
