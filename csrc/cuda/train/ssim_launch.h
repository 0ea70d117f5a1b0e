// Launchers of SSIM and the photometric loss; torch-free.
#pragma once

#include <cuda_runtime_api.h>

#include "core/train/ssim.h"

namespace gsf::cuda {

// How the rows of an image are shared out, and the scratch that takes.
struct SsimPlan {
  int map_columns, map_rows;      // CTAs of the moments
  int map_height;                 // rows of each
  int image_columns, image_rows;  // CTAs of the gradient or of the pixel sums
  int image_height;

  int64_t map_blocks() const { return int64_t(map_columns) * map_rows; }
  int64_t image_blocks() const { return int64_t(image_columns) * image_rows; }
  // doubles: one sum per CTA of the moments, kSsimSums - 1 per CTA of the pixels
  int64_t sums() const { return map_blocks() + (kSsimSums - 1) * image_blocks(); }
};

template <typename T>
cudaError_t ssim_plan(const SsimArgs<T>& a, int device, SsimPlan& plan);

// `slopes` holds three times the map when there is a gradient; `sums` holds plan.sums() when there
// is a loss.
template <typename T>
cudaError_t ssim(const SsimArgs<T>& a, const SsimPlan& plan, T* slopes, double* sums,
                 cudaStream_t stream);

}  // namespace gsf::cuda
