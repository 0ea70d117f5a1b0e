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

template <typename T>
const T* cptr(const OptTensor& t) {
  return t.has_value() ? cptr<T>(*t) : nullptr;
}

inline Tensor contiguous(const Tensor& t) {
  return t.is_contiguous() ? t : torch::stable::contiguous(t);
}

// An argument as kernels take it: of this shape and dtype, on the device of `like`, contiguous.
inline Tensor ready(const char* op, const char* name, const Tensor& t, const Tensor& like,
                    const std::vector<int64_t>& shape, ScalarType dtype) {
  check_shape(op, name, t, shape);
  check_dtype(op, name, t, dtype);
  check_same_device(op, name, t, like);
  return gsf::contiguous(t);
}
inline OptTensor ready(const char* op, const char* name, const OptTensor& t, const Tensor& like,
                       const std::vector<int64_t>& shape, ScalarType dtype) {
  return t.has_value() ? OptTensor(ready(op, name, *t, like, shape, dtype)) : OptTensor();
}
// The same with the dtype of `like`; T is Tensor or OptTensor.
template <typename T>
T ready(const char* op, const char* name, const T& t, const Tensor& like,
        const std::vector<int64_t>& shape) {
  return ready(op, name, t, like, shape, like.scalar_type());
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

// What the CUDA back ends need around a kernel (cuda/stream.h); nothing on the CPU.
struct CpuScope {
  explicit CpuScope(const Tensor&) {}
};

// Splits [0, n) over torch's CPU threads; `f(begin, end)`.
template <typename F>
void parallel_for(int64_t n, int64_t grain, const F& f) {
  if (n > 0) torch::stable::parallel_for(0, n, grain, f);
}

// --- registration ---

// A parameter of an operator, from the values of its schema. A struct that stands for several of
// them specialises it.
template <typename T>
struct Unbox {
  static constexpr uint64_t kValues = 1;
  static T take(StableIValue*& at) { return torch::stable::detail::to<T>(*at++); }
};

template <auto kOp>
struct Boxed;
template <typename Result, typename... Parameters, Result (*kOp)(Parameters...)>
struct Boxed<kOp> {
  static void call(StableIValue* stack, uint64_t values, uint64_t results) {
    constexpr uint64_t kValues = (0 + ... + Unbox<std::remove_cvref_t<Parameters>>::kValues);
    STD_TORCH_CHECK(values == kValues, "the schema has ", values, " arguments, the kernel ",
                    kValues);
    StableIValue* at = stack;
    // In braces: from left to right.
    std::tuple<std::remove_cvref_t<Parameters>...> given{
        Unbox<std::remove_cvref_t<Parameters>>::take(at)...};
    if constexpr (std::is_void_v<Result>) {
      STD_TORCH_CHECK(results == 0, "the kernel returns nothing");
      std::apply(kOp, std::move(given));
    } else {
      give(stack, results, std::apply(kOp, std::move(given)));
    }
  }

 private:
  template <typename... T>
  static void give(StableIValue* stack, uint64_t results, std::tuple<T...> all) {
    STD_TORCH_CHECK(results == sizeof...(T), "the schema has ", results, " results, the kernel ",
                    sizeof...(T));
    std::apply([&](T&... one) { ((*stack++ = torch::stable::detail::from(one)), ...); }, all);
  }
  template <typename T>
  static void give(StableIValue* stack, uint64_t results, T one) {
    give(stack, results, std::tuple<T>(std::move(one)));
  }
};

// The operators of a family, `Ops` for the back end of dispatch key `key`: `Ops::name(...)`
// implements gsfluent::name. GSF_IMPL stands in `Ops::register_all(m)`.
using Library = torch::stable::detail::StableLibrary;
#define GSF_IMPL(Ops, name) m.impl(#name, TORCH_BOX(&Ops::name))
// The same where a parameter stands for several values of the schema.
#define GSF_IMPL_UNBOX(Ops, name) m.impl(#name, &gsf::Boxed<&Ops::name>::call)
#define GSF_REGISTER(key, ...) \
  STABLE_TORCH_LIBRARY_IMPL(gsfluent, key, m) { __VA_ARGS__::register_all(m); }

}  // namespace gsf
