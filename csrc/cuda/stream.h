// The current CUDA stream of a tensor's device, through the stable C shim; device guard. Included
// by ops.cpp only.
#pragma once

#include <cuda_runtime_api.h>
#include <torch/csrc/inductor/aoti_torch/c/shim.h>

#include "torch_api.h"

namespace gsf {

// Makes the tensor's device current for the lifetime of the object and yields its current stream.
class CudaScope {
 public:
  explicit CudaScope(const Tensor& t) : index_(t.get_device_index()), guard_(index_) {}
  int index() const { return index_; }
  cudaStream_t stream() const {
    void* s = nullptr;
    TORCH_ERROR_CODE_CHECK(aoti_torch_get_current_cuda_stream(index_, &s));
    return static_cast<cudaStream_t>(s);
  }

 private:
  int32_t index_;
  torch::stable::accelerator::DeviceGuard guard_;
};

}  // namespace gsf
