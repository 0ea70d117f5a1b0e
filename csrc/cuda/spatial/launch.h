// Launchers of the spatial kernels: torch-free.
#pragma once

#include <cuda_runtime_api.h>

#include "core/distance.h"
#include "core/labels.h"
#include "core/nearest.h"
#include "core/spatial.h"

namespace gsf::cuda {

cudaError_t nearest_labels(const NearestLabelsArgs& a, cudaStream_t stream);
cudaError_t largest_shares(const LargestSharesArgs& a, cudaStream_t stream);
cudaError_t nearest_points(const NearestArgs& a, cudaStream_t stream);
cudaError_t box_sum(const BoxSumArgs& a, cudaStream_t stream);
cudaError_t distance_pass(const DistanceArgs& a, cudaStream_t stream);
template <typename T>
cudaError_t trilinear(const TrilinearArgs<T>& a, cudaStream_t stream);
cudaError_t value_noise(const ValueNoiseArgs& a, cudaStream_t stream);
cudaError_t hashes(const HashesArgs& a, cudaStream_t stream);
cudaError_t label_boxes(const LabelBoxesArgs& a, cudaStream_t stream);
cudaError_t margin_counts(const MarginCountsArgs& a, cudaStream_t stream);

}  // namespace gsf::cuda
