// Activations and rules of shape on the GPU: a thread for a value of the harmonics, of whom the
// first also take a splat's shape; a thread for an axis.
#include "cuda/threads.h"
#include "cuda/train/activation_launch.h"

namespace gsf::cuda {
namespace {

template <typename Args>
__global__ void activate_kernel(Args a) {
  const int64_t i = thread_number();
  if (i < a.items()) gsf::activate(a, i);
}

template <typename Args>
__global__ void activate_backward_kernel(Args a) {
  const int64_t i = thread_number();
  if (i < a.items()) gsf::activate_backward(a, i);
}

template <typename T>
__global__ void clamp_aspect_kernel(AspectArgs<T> a) {
  const int64_t i = thread_number();
  if (i < a.count) gsf::clamp_aspect(a, i);
}

template <typename T>
__global__ void shorten_axes_kernel(ShortenArgs<T> a) {
  const int64_t i = thread_number();
  if (i < 3 * a.count) gsf::shorten_axes(a, i);
}

}  // namespace

template <typename T>
cudaError_t activate(const ActivationArgs<T>& a, cudaStream_t stream) {
  if (a.count) activate_kernel<<<blocks_for(a.items()), kThreads, 0, stream>>>(a);
  return cudaGetLastError();
}

template <typename T>
cudaError_t activate_backward(const ActivationGradArgs<T>& a, cudaStream_t stream) {
  if (a.count) activate_backward_kernel<<<blocks_for(a.items()), kThreads, 0, stream>>>(a);
  return cudaGetLastError();
}

template <typename T>
cudaError_t clamp_aspect(const AspectArgs<T>& a, cudaStream_t stream) {
  if (a.count) clamp_aspect_kernel<<<blocks_for(a.count), kThreads, 0, stream>>>(a);
  return cudaGetLastError();
}

template <typename T>
cudaError_t shorten_axes(const ShortenArgs<T>& a, cudaStream_t stream) {
  if (a.count) shorten_axes_kernel<<<blocks_for(3 * a.count), kThreads, 0, stream>>>(a);
  return cudaGetLastError();
}

#define GSF_BOTH(name, Args)                                   \
  template cudaError_t name(const Args<float>&, cudaStream_t); \
  template cudaError_t name(const Args<double>&, cudaStream_t);
GSF_BOTH(activate, ActivationArgs)
GSF_BOTH(activate_backward, ActivationGradArgs)
GSF_BOTH(clamp_aspect, AspectArgs)
GSF_BOTH(shorten_axes, ShortenArgs)

}  // namespace gsf::cuda
