// Launchers of the ellipsoid kernels: what ops.cpp may call. Torch-free.
#pragma once

#include <cuda_runtime_api.h>

#include "core/mvee/args.h"

namespace gsf::cuda {

// Values of type T that mvee needs as scratch; none for small sets.
template <typename T>
int64_t mvee_scratch(const MveeArgs<T>& args);

template <typename T>
cudaError_t mvee(const MveeArgs<T>& args, T* scratch, int64_t size, cudaStream_t stream);

// Scratch of mvee_lens: the pairs that need a fit, at most `kLensChunk` at a time (277 MB). One fit
// takes about half a millisecond from start to end, so that few long chunks go faster than many.
inline constexpr int64_t kLensChunk = 1 << 20;
inline constexpr int64_t kLensFields = 33;  // doubles of a pair's LensSetup

template <typename T>
cudaError_t mvee_lens(const MveeLensArgs<T>& args, double* setups, int32_t* rows, int32_t* count,
                      cudaStream_t stream);

}  // namespace gsf::cuda
