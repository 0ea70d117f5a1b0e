// Launchers of activations and rules of shape; torch-free.
#pragma once

#include <cuda_runtime_api.h>

#include "core/train/activation.h"

namespace gsf::cuda {

template <typename T>
cudaError_t activate(const ActivationArgs<T>& a, cudaStream_t stream);
template <typename T>
cudaError_t activate_backward(const ActivationGradArgs<T>& a, cudaStream_t stream);
template <typename T>
cudaError_t clamp_aspect(const AspectArgs<T>& a, cudaStream_t stream);
template <typename T>
cudaError_t shorten_axes(const ShortenArgs<T>& a, cudaStream_t stream);

}  // namespace gsf::cuda
