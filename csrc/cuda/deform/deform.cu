// CUDA kernels of the deformation ops: one thread per matrix or Gaussian.
#include "core/deform/carry.h"
#include "core/deform/cut.h"
#include "core/deform/faces.h"
#include "core/deform/link.h"
#include "core/deform/turn.h"
#include "cuda/deform/launch.h"
#include "cuda/threads.h"

namespace gsf::cuda {
namespace {

template <typename T>
__global__ void polar_kernel(PolarArgs<T> a) {
  const int64_t i = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i >= a.count) return;
  Mat3<T> rotation, clamped;
  gsf::polar_clamped(load_mat3(a.deformation + 9 * i), a.lo, a.hi, rotation, clamped);
  store_mat3(a.rotation + 9 * i, rotation);
  store_mat3(a.clamped + 9 * i, clamped);
}

template <typename T>
__global__ void covariance_axes_kernel(CovarianceAxesArgs<T> a) {
  const int64_t i = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i < a.count) gsf::covariance_axes(a, i);
}

template <typename T>
__global__ void carry_place_kernel(CarryPlaceArgs<T> a) {
  const int64_t i = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i < a.count) gsf::carry_place(a, i);
}

template <typename T>
__global__ void carry_axes_kernel(CarryAxesArgs<T> a) {
  const int64_t i = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i < a.count) gsf::carry_axes(a, i);
}

template <typename T>
__global__ void quats_to_matrices_kernel(TurnArgs<T> a) {
  const int64_t i = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i < a.count) gsf::quats_to_matrices(a, i);
}

template <typename T>
__global__ void matrices_to_quats_kernel(TurnArgs<T> a) {
  const int64_t i = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i < a.count) gsf::matrices_to_quats(a, i);
}

template <typename T>
__global__ void quat_products_kernel(TurnArgs<T> a) {
  const int64_t i = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i < a.count) gsf::quat_products(a, i);
}

template <typename T>
__global__ void link_states_kernel(LinkStatesArgs<T> a) {
  const int64_t i = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i < a.count) gsf::link_states(a, i);
}

template <typename T>
__global__ void find_faces_kernel(FaceArgs<T> a) {
  const int64_t i = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  const int columns = a.near_count + 1;
  if (i < a.count * columns) a.has[i] = has_face(a, i / columns, static_cast<int>(i % columns));
}

template <typename T>
__global__ void face_elements_kernel(FaceArgs<T> a) {
  const int64_t i = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i < a.count) face_element(a, i);
}

template <typename T>
__global__ void cut_at_cells_kernel(CutAtCellsArgs<T> a) {
  const int64_t i = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i < a.count) gsf::cut_at_cells(a, i);
}

template <typename T>
__global__ void cut_by_planes_kernel(CutByPlanesArgs<T> a) {
  const int64_t i = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i < a.count) gsf::cut_by_planes(a, i);
}

template <typename Args, typename Kernel>
cudaError_t launch(const Args& args, cudaStream_t stream, Kernel kernel) {
  if (args.count == 0) return cudaSuccess;
  kernel<<<blocks_for<kFewThreads>(args.count), kFewThreads, 0, stream>>>(args);
  return cudaGetLastError();
}

}  // namespace

template <typename T>
cudaError_t polar_clamped(const PolarArgs<T>& args, cudaStream_t stream) {
  return launch(args, stream, polar_kernel<T>);
}
template <typename T>
cudaError_t covariance_axes(const CovarianceAxesArgs<T>& args, cudaStream_t stream) {
  return launch(args, stream, covariance_axes_kernel<T>);
}
template <typename T>
cudaError_t carry_place(const CarryPlaceArgs<T>& args, cudaStream_t stream) {
  return launch(args, stream, carry_place_kernel<T>);
}
template <typename T>
cudaError_t carry_axes(const CarryAxesArgs<T>& args, cudaStream_t stream) {
  return launch(args, stream, carry_axes_kernel<T>);
}
template <typename T>
cudaError_t quats_to_matrices(const TurnArgs<T>& args, cudaStream_t stream) {
  return launch(args, stream, quats_to_matrices_kernel<T>);
}
template <typename T>
cudaError_t matrices_to_quats(const TurnArgs<T>& args, cudaStream_t stream) {
  return launch(args, stream, matrices_to_quats_kernel<T>);
}
template <typename T>
cudaError_t quat_products(const TurnArgs<T>& args, cudaStream_t stream) {
  return launch(args, stream, quat_products_kernel<T>);
}
template <typename T>
cudaError_t link_states(const LinkStatesArgs<T>& args, cudaStream_t stream) {
  return launch(args, stream, link_states_kernel<T>);
}
template <typename T>
cudaError_t find_faces(const FaceArgs<T>& args, cudaStream_t stream) {
  const int64_t pairs = args.count * (args.near_count + 1);
  if (pairs == 0) return cudaSuccess;
  find_faces_kernel<T><<<blocks_for<kFewThreads>(pairs), kFewThreads, 0, stream>>>(args);
  return cudaGetLastError();
}
template <typename T>
cudaError_t face_elements(const FaceArgs<T>& args, cudaStream_t stream) {
  return launch(args, stream, face_elements_kernel<T>);
}
template <typename T>
cudaError_t cut_at_cells(const CutAtCellsArgs<T>& args, cudaStream_t stream) {
  return launch(args, stream, cut_at_cells_kernel<T>);
}
template <typename T>
cudaError_t cut_by_planes(const CutByPlanesArgs<T>& args, cudaStream_t stream) {
  return launch(args, stream, cut_by_planes_kernel<T>);
}

template cudaError_t polar_clamped(const PolarArgs<float>&, cudaStream_t);
template cudaError_t polar_clamped(const PolarArgs<double>&, cudaStream_t);
template cudaError_t covariance_axes(const CovarianceAxesArgs<float>&, cudaStream_t);
template cudaError_t covariance_axes(const CovarianceAxesArgs<double>&, cudaStream_t);
template cudaError_t carry_place(const CarryPlaceArgs<float>&, cudaStream_t);
template cudaError_t carry_place(const CarryPlaceArgs<double>&, cudaStream_t);
template cudaError_t carry_axes(const CarryAxesArgs<float>&, cudaStream_t);
template cudaError_t carry_axes(const CarryAxesArgs<double>&, cudaStream_t);
template cudaError_t quats_to_matrices(const TurnArgs<float>&, cudaStream_t);
template cudaError_t quats_to_matrices(const TurnArgs<double>&, cudaStream_t);
template cudaError_t matrices_to_quats(const TurnArgs<float>&, cudaStream_t);
template cudaError_t matrices_to_quats(const TurnArgs<double>&, cudaStream_t);
template cudaError_t quat_products(const TurnArgs<float>&, cudaStream_t);
template cudaError_t quat_products(const TurnArgs<double>&, cudaStream_t);
template cudaError_t link_states(const LinkStatesArgs<float>&, cudaStream_t);
template cudaError_t link_states(const LinkStatesArgs<double>&, cudaStream_t);
template cudaError_t find_faces(const FaceArgs<float>&, cudaStream_t);
template cudaError_t find_faces(const FaceArgs<double>&, cudaStream_t);
template cudaError_t face_elements(const FaceArgs<float>&, cudaStream_t);
template cudaError_t face_elements(const FaceArgs<double>&, cudaStream_t);
template cudaError_t cut_at_cells(const CutAtCellsArgs<float>&, cudaStream_t);
template cudaError_t cut_at_cells(const CutAtCellsArgs<double>&, cudaStream_t);
template cudaError_t cut_by_planes(const CutByPlanesArgs<float>&, cudaStream_t);
template cudaError_t cut_by_planes(const CutByPlanesArgs<double>&, cudaStream_t);

}  // namespace gsf::cuda
