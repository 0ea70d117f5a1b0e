// Launchers of the deformation kernels: what ops.cpp may call. Torch-free.
#pragma once

#include <cuda_runtime_api.h>

#include "core/deform/args.h"

namespace gsf::cuda {

template <typename T>
cudaError_t polar_clamped(const PolarArgs<T>& args, cudaStream_t stream);

template <typename T>
cudaError_t covariance_axes(const CovarianceAxesArgs<T>& args, cudaStream_t stream);

template <typename T>
cudaError_t carry_place(const CarryPlaceArgs<T>& args, cudaStream_t stream);

template <typename T>
cudaError_t carry_axes(const CarryAxesArgs<T>& args, cudaStream_t stream);

template <typename T>
cudaError_t quats_to_matrices(const TurnArgs<T>& args, cudaStream_t stream);

template <typename T>
cudaError_t matrices_to_quats(const TurnArgs<T>& args, cudaStream_t stream);

template <typename T>
cudaError_t quat_products(const TurnArgs<T>& args, cudaStream_t stream);

template <typename T>
cudaError_t link_states(const LinkStatesArgs<T>& args, cudaStream_t stream);

template <typename T>
cudaError_t find_faces(const FaceArgs<T>& args, cudaStream_t stream);

template <typename T>
cudaError_t face_elements(const FaceArgs<T>& args, cudaStream_t stream);

template <typename T>
cudaError_t cut_at_cells(const CutAtCellsArgs<T>& args, cudaStream_t stream);

template <typename T>
cudaError_t cut_by_planes(const CutByPlanesArgs<T>& args, cudaStream_t stream);

}  // namespace gsf::cuda
