// The current CUDA stream of a tensor's device, through the stable C shim; device guard. Included
// by ops.cpp only.
#pragma once

#include <cuda_runtime_api.h>
#include <torch/csrc/inductor/aoti_torch/c/shim.h>

#include "torch_api.h"

namespace gsf {

// Makes the tensor's device current for the lifetime of the object and yields its current stream.
// The tensor has to outlive it.
class CudaScope {
 public:
  explicit CudaScope(const Tensor& t) : like_(t), index_(t.get_device_index()), guard_(index_) {}
  int index() const { return index_; }
  // Not initialised, on the device, for the lifetime of the tensor returned.
  Tensor scratch(int64_t count, ScalarType dtype) const {
    return gsf::new_empty(like_, {count}, dtype);
  }
  cudaStream_t stream() const {
    void* s = nullptr;
    TORCH_ERROR_CODE_CHECK(aoti_torch_get_current_cuda_stream(index_, &s));
    return static_cast<cudaStream_t>(s);
  }

 private:
  const Tensor& like_;
  int32_t index_;
  torch::stable::accelerator::DeviceGuard guard_;
};

inline void check_cuda(const char* op, cudaError_t error) {
  STD_TORCH_CHECK(error == cudaSuccess, op, ": CUDA error: ", cudaGetErrorString(error));
}

}  // namespace gsf

// A member of a back end: the launcher of the same name, on the current stream.
#define GSF_LAUNCH(name)                                       \
  template <typename Args>                                     \
  static void name(const Args& args, const CudaScope& scope) { \
    check_cuda(#name, cuda::name(args, scope.stream()));       \
  }
