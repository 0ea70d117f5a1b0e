// The optimiser step on the GPU: one launch for all tensors. A CTA takes whole rows, so that it can
// see which of them hold a gradient that is not finite before any value changes.
#include "cuda/train/adam_launch.h"

namespace gsf::cuda {
namespace {

constexpr int kThreads = 256;
constexpr int kValues = 2048;  // of a CTA, unless one row is longer

struct AdamPlan {
  unsigned first_block[kAdamTensors + 1];  // of each tensor; the last entry counts all
  int rows[kAdamTensors];                  // of a CTA
};

template <typename T>
__global__ __launch_bounds__(kThreads) void adam_kernel(AdamArgs<T> args, AdamPlan plan) {
  __shared__ unsigned char out[kValues];  // rows left out
  int k = 0;
  while (k + 1 < args.count && blockIdx.x >= plan.first_block[k + 1]) ++k;
  const AdamTensor<T>& t = args.tensors[k];
  const int64_t first = int64_t(blockIdx.x - plan.first_block[k]) * plan.rows[k];
  const int rows = int(min(int64_t(plan.rows[k]), t.rows - first));
  const int64_t start = first * t.columns, count = rows * t.columns;
  // a CTA of several rows has at most kValues values
  const unsigned columns = rows > 1 ? unsigned(t.columns) : 1u;
  const auto row_of = [&](int64_t i) { return rows > 1 ? int(unsigned(i) / columns) : 0; };

  for (int row = threadIdx.x; row < rows; row += kThreads) out[row] = !args.visible(first + row);
  __syncthreads();
#pragma unroll 4
  for (int64_t i = threadIdx.x; i < count; i += kThreads) {
    const int row = row_of(i);
    // several threads may write here, all of them 1
    if (!out[row] && !finite(t.gradient[start + i])) out[row] = 1;
  }
  __syncthreads();
#pragma unroll 4
  for (int64_t i = threadIdx.x; i < count; i += kThreads) {
    if (out[row_of(i)]) continue;
    const int64_t at = start + i;
    T value = t.value[at], m = t.first[at], v = t.second[at];
    adam_update(t.rates, t.gradient[at], m, v, value);
    t.value[at] = value;
    t.first[at] = m;
    t.second[at] = v;
  }
}

}  // namespace

template <typename T>
cudaError_t adam_step(const AdamArgs<T>& args, cudaStream_t stream) {
  AdamPlan plan{};
  int64_t blocks = 0;
  for (int k = 0; k < args.count; ++k) {
    const AdamTensor<T>& t = args.tensors[k];
    const int64_t rows = t.columns < kValues ? kValues / t.columns : 1;
    plan.rows[k] = static_cast<int>(rows);
    plan.first_block[k] = static_cast<unsigned>(blocks);
    blocks += (t.rows + rows - 1) / rows;
    if (blocks > INT32_MAX) return cudaErrorInvalidConfiguration;
  }
  plan.first_block[args.count] = static_cast<unsigned>(blocks);
  if (blocks == 0) return cudaSuccess;
  adam_kernel<T><<<static_cast<unsigned>(blocks), kThreads, 0, stream>>>(args, plan);
  return cudaGetLastError();
}

template cudaError_t adam_step(const AdamArgs<float>&, cudaStream_t);
template cudaError_t adam_step(const AdamArgs<double>&, cudaStream_t);

}  // namespace gsf::cuda
