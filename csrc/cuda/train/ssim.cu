// SSIM and the photometric loss on the GPU. A CTA takes 128 neighbouring values of a row (pixels
// and channels interleaved, so that reads are whole lines) and walks down the image: each row is
// blurred along x out of shared memory, and pushed into ten running sums per plane in registers,
// which are the blur along y. Nothing but three planes of slopes goes through memory between the
// two passes.
#include "cuda/train/ssim_launch.h"

namespace gsf::cuda {
namespace {

constexpr int kColumns = 128;
constexpr int kTaps = kSsimWindow - 1;
constexpr int kLeastRows = 8;
constexpr unsigned kAllLanes = 0xffffffffu;

template <typename T>
constexpr int kCtasPerSm = sizeof(T) == 4 ? 5 : 2;

// Values of a row that a thread loads: its own, and its part of the ten pixels around.
template <int kC>
constexpr int kLoads = (kColumns + kTaps * (kC == 0 ? 32 : kC) + kColumns - 1) / kColumns;

// Running sums of the blur along y: running[j] is the row that will be complete after j + 1 more
// pushes. Returns the row that is complete now.
template <typename T>
__device__ __forceinline__ T push(T (&running)[kTaps], T value) {
  const T complete = running[0] + ssim_tap<T>(kTaps) * value;
#pragma unroll
  for (int j = 0; j + 1 < kTaps; ++j)
    running[j] = running[j + 1] + ssim_tap<T>(kTaps - 1 - j) * value;
  running[kTaps - 1] = ssim_tap<T>(0) * value;
  return complete;
}

// Sums over the CTA, written by thread 0; the order is fixed.
template <int kSums>
__device__ void store_sums(const double (&mine)[kSums], double* out) {
  __shared__ double warps[kSums][kColumns / 32];
  for (int q = 0; q < kSums; ++q) {
    double total = mine[q];
    for (int step = 16; step > 0; step /= 2) total += __shfl_down_sync(kAllLanes, total, step);
    if (threadIdx.x % 32 == 0) warps[q][threadIdx.x / 32] = total;
  }
  __syncthreads();
  if (threadIdx.x != 0) return;
  for (int q = 0; q < kSums; ++q) {
    double total = 0;
    for (int w = 0; w < kColumns / 32; ++w) total += warps[q][w];
    out[q] = total;
  }
}

// x (times valid) and y: value `at` of the image, of pixel `pixel`.
template <typename T>
__device__ __forceinline__ void load_pair(const SsimArgs<T>& a, int64_t at, int64_t pixel, T& x,
                                          T& y) {
  x = a.image[at];
  y = a.target[at];
  if (a.valid != nullptr) x *= a.valid[pixel];
}

// The map, its sum per CTA, its slopes. kC: channels, 0 when only known at run time.
template <typename T, int kC>
__global__ __launch_bounds__(kColumns, kCtasPerSm<T>) void moments_kernel(SsimArgs<T> a, int rows,
                                                                          T* slopes, double* sums) {
  extern __shared__ __align__(16) unsigned char shared_bytes[];
  T* const shared = reinterpret_cast<T*>(shared_bytes);
  const int channels = kC == 0 ? int(a.channels) : kC;
  const int pitch = kColumns + kTaps * channels;
  const int row_values = int(a.width) * channels;
  const int inset = int(a.inset);
  const int height = int(a.height), map_height = height - 2 * inset;
  const int map_values = row_values - 2 * inset * channels;
  const int column = blockIdx.x * kColumns + threadIdx.x;  // of the map
  const int first = blockIdx.y * rows, last = min(first + rows, map_height);
  // value of the image row behind place 0 in shared memory
  const int origin = blockIdx.x * kColumns + (inset - kSsimRadius) * channels;

  const int begin = first + inset - kSsimRadius, end = last + inset + kSsimRadius;
  T next_m[kLoads<kC>], next_d[kLoads<kC>];
  int64_t next_at = int64_t(begin) * row_values + origin + threadIdx.x;
  const auto fetch = [&](int row) {
#pragma unroll
    for (int n = 0; n < kLoads<kC>; ++n) {
      const int place = threadIdx.x + n * kColumns, i = origin + place;
      next_m[n] = T(kSsimOutside);
      next_d[n] = T(0);
      if (place >= pitch || i < 0 || i >= row_values || row < 0 || row >= height) continue;
      T x, y;
      load_pair(a, next_at + n * kColumns, row * a.width + i / channels, x, y);
      next_m[n] = T(0.5) * (x + y) + T(kSsimOutside);
      next_d[n] = x - y;
    }
    next_at += row_values;
  };

  T run_m[kTaps] = {}, run_d[kTaps] = {}, run_mm[kTaps] = {}, run_dd[kTaps] = {};
  double total[1] = {0};
  int64_t at = int64_t(first) * map_values + column;  // of the map
  const int64_t plane = int64_t(map_height) * map_values;
  fetch(begin);
  for (int row = begin; row < end; ++row) {
    // two buffers: whoever writes one again has met all others at the barrier in between
    T* const m = shared + ((row - begin) % 2) * 2 * pitch;
    T* const d = m + pitch;
#pragma unroll
    for (int n = 0; n < kLoads<kC>; ++n) {
      const int place = threadIdx.x + n * kColumns;
      if (place >= pitch) continue;
      m[place] = next_m[n];
      d[place] = next_d[n];
    }
    __syncthreads();
    if (row + 1 < end) fetch(row + 1);
    SsimMoments<T> w{T(0), T(0), T(0), T(0)};
#pragma unroll
    for (int k = 0; k < kSsimWindow; ++k) {
      const T vm = m[threadIdx.x + k * channels], vd = d[threadIdx.x + k * channels];
      const T wm = ssim_tap<T>(k) * vm, wd = ssim_tap<T>(k) * vd;
      w.m += wm;
      w.d += wd;
      w.mm += wm * vm;
      w.dd += wd * vd;
    }
    w = {push(run_m, w.m), push(run_d, w.d), push(run_mm, w.mm), push(run_dd, w.dd)};
    const int i = row - inset - kSsimRadius;  // row of the map that is complete
    if (i < first || column >= map_values) continue;
    SsimSlopes<T> s;
    const T value = ssim_value(w, s);
    total[0] += double(value);
    if (a.map != nullptr) a.map[at] = value;
    if (slopes != nullptr) {
      const T g = a.map_slope != nullptr ? a.map_slope[at] : a.similarity_slope;
      slopes[at] = g * s.linear;
      slopes[plane + at] = g * s.square_m;
      slopes[2 * plane + at] = g * s.square_d;
    }
    at += map_values;
  }
  if (sums != nullptr) store_sums(total, sums + int64_t(blockIdx.y) * gridDim.x + blockIdx.x);
}

// |miss|, miss^2, |excess| of one value, channel c of pixel p, into `total`; writes the slope of
// alpha. Returns the slope of |miss|.
template <typename T>
__device__ __forceinline__ T add_pixel(const SsimArgs<T>& a, int64_t p, int c, T x, T y,
                                       double (&total)[kSsimSums - 1]) {
  const T excess = ssim_excess(a, p);
  const T miss = ssim_miss(a, c, x, y, excess);
  total[0] += double(miss < T(0) ? -miss : miss);
  total[1] += double(miss) * double(miss);
  if (c == 0 && a.alpha != nullptr) {
    total[2] += double(excess < T(0) ? -excess : excess);
    if (a.grad_alpha != nullptr) a.grad_alpha[p] = ssim_alpha_slope(a, p, excess);
  }
  return a.miss_slope * sign_of(miss);
}

// Gradient of the image from the slopes of the map, and the sums over pixels.
template <typename T, int kC>
__global__ __launch_bounds__(kColumns, kCtasPerSm<T>) void gradient_kernel(SsimArgs<T> a, int rows,
                                                                           const T* slopes,
                                                                           double* sums) {
  extern __shared__ __align__(16) unsigned char shared_bytes[];
  T* const shared = reinterpret_cast<T*>(shared_bytes);
  const int channels = kC == 0 ? int(a.channels) : kC;
  const int pitch = kColumns + kTaps * channels;
  const int row_values = int(a.width) * channels;
  const int inset = int(a.inset);
  const int height = int(a.height), map_height = height - 2 * inset;
  const int map_values = row_values - 2 * inset * channels;
  const int64_t plane = int64_t(map_height) * map_values;
  const int column = blockIdx.x * kColumns + threadIdx.x;  // of the image
  const int pixel = column / channels, channel = column % channels;
  const int first = blockIdx.y * rows, last = min(first + rows, height);
  const int origin = blockIdx.x * kColumns - (inset + kSsimRadius) * channels;

  const int begin = first - inset - kSsimRadius, end = last - inset + kSsimRadius;
  T next[3][kLoads<kC>];
  int64_t next_at = int64_t(begin) * map_values + origin + threadIdx.x;
  const auto fetch = [&](int row) {  // of the map; zeros outside
#pragma unroll
    for (int n = 0; n < kLoads<kC>; ++n) {
      const int place = threadIdx.x + n * kColumns, i = origin + place;
      const bool there = place < pitch && i >= 0 && i < map_values && row >= 0 && row < map_height;
      const T* const from = slopes + next_at + n * kColumns;
#pragma unroll
      for (int q = 0; q < 3; ++q) next[q][n] = there ? from[q * plane] : T(0);
    }
    next_at += map_values;
  };

  T running[3][kTaps] = {};
  double total[kSsimSums - 1] = {};
  int64_t at = int64_t(first) * row_values + column;  // of the image
  int64_t p = int64_t(first) * a.width + pixel;
  fetch(begin);
  for (int row = begin; row < end; ++row) {
    T* const buffer = shared + ((row - begin) % 2) * 3 * pitch;
#pragma unroll
    for (int n = 0; n < kLoads<kC>; ++n) {
      const int place = threadIdx.x + n * kColumns;
      if (place >= pitch) continue;
#pragma unroll
      for (int q = 0; q < 3; ++q) buffer[q * pitch + place] = next[q][n];
    }
    __syncthreads();
    if (row + 1 < end) fetch(row + 1);
    const int r = row + inset - kSsimRadius;  // row of the gradient that is complete
    const bool mine = r >= first && column < row_values;
    T x = T(0), y = T(0);
    if (mine) load_pair(a, at, p, x, y);
    T w[3];
#pragma unroll
    for (int q = 0; q < 3; ++q) {
      T across = T(0);
#pragma unroll
      for (int k = 0; k < kSsimWindow; ++k)
        across += ssim_tap<T>(k) * buffer[q * pitch + threadIdx.x + k * channels];
      w[q] = push(running[q], across);
    }
    if (!mine) continue;
    T gradient = w[0] + (T(0.5) * (x + y) + T(kSsimOutside)) * w[1] + (x - y) * w[2];
    if (a.pixels) gradient += add_pixel(a, p, channel, x, y, total);
    a.grad_image[at] = a.valid == nullptr ? gradient : a.valid[p] * gradient;
    at += row_values;
    p += a.width;
  }
  if (sums != nullptr)
    store_sums(total, sums + (kSsimSums - 1) * (int64_t(blockIdx.y) * gridDim.x + blockIdx.x));
}

// The sums over pixels alone, where no gradient is wanted.
template <typename T>
__global__ __launch_bounds__(kColumns) void pixels_kernel(SsimArgs<T> a, int rows, double* sums) {
  const int column = blockIdx.x * kColumns + threadIdx.x;
  const int channels = int(a.channels);
  const int first = blockIdx.y * rows, last = min(first + rows, int(a.height));
  double total[kSsimSums - 1] = {};
  if (column < a.width * channels)
    for (int r = first; r < last; ++r) {
      const int64_t p = int64_t(r) * a.width + column / channels;
      T x, y;
      load_pair(a, p * channels + column % channels, p, x, y);
      add_pixel(a, p, column % channels, x, y, total);
    }
  store_sums(total, sums + (kSsimSums - 1) * (int64_t(blockIdx.y) * gridDim.x + blockIdx.x));
}

// One CTA: the sums of all others in a fixed order, then the loss.
template <typename T>
__global__ __launch_bounds__(kColumns) void finish_kernel(SsimArgs<T> a, int64_t map_blocks,
                                                          int64_t image_blocks, const double* sums,
                                                          bool pixels) {
  __shared__ double totals[kSsimSums];
  double mine[kSsimSums] = {};
  for (int64_t i = threadIdx.x; i < map_blocks; i += kColumns) mine[kSumSimilarity] += sums[i];
  const double* rest = sums + map_blocks;
  if (pixels)
    for (int64_t i = threadIdx.x; i < image_blocks; i += kColumns)
      for (int q = 1; q < kSsimSums; ++q) mine[q] += rest[(kSsimSums - 1) * i + q - 1];
  store_sums(mine, totals);
  if (threadIdx.x == 0) ssim_finish(a, totals);
}

int parts(int64_t count, int64_t size) { return static_cast<int>((count + size - 1) / size); }

// Rows per CTA such that all CTAs run at once: each repeats ten rows, so tall ones are cheap.
int rows_of(int64_t columns, int64_t height, int64_t slots) {
  const int64_t stacks = slots / columns > 0 ? slots / columns : 1;
  const int64_t rows = (height + stacks - 1) / stacks;
  return static_cast<int>(rows < kLeastRows ? kLeastRows : rows);
}

template <typename T, int kC>
cudaError_t launch(const SsimArgs<T>& a, const SsimPlan& p, T* slopes, double* sums,
                   cudaStream_t stream) {
  const size_t pitch = static_cast<size_t>(kColumns + kTaps * a.channels);
  const dim3 map_grid(p.map_columns, p.map_rows), image_grid(p.image_columns, p.image_rows);
  double* const pixel_sums = sums == nullptr ? nullptr : sums + p.map_blocks();
  moments_kernel<T, kC>
      <<<map_grid, kColumns, 4 * pitch * sizeof(T), stream>>>(a, p.map_height, slopes, sums);
  if (slopes != nullptr)
    gradient_kernel<T, kC><<<image_grid, kColumns, 6 * pitch * sizeof(T), stream>>>(
        a, p.image_height, slopes, pixel_sums);
  else if (a.pixels)
    pixels_kernel<T><<<image_grid, kColumns, 0, stream>>>(a, p.image_height, pixel_sums);
  if (a.loss != nullptr)
    finish_kernel<T>
        <<<1, kColumns, 0, stream>>>(a, p.map_blocks(), p.image_blocks(), sums, a.pixels);
  return cudaGetLastError();
}

}  // namespace

template <typename T>
cudaError_t ssim_plan(const SsimArgs<T>& a, int device, SsimPlan& plan) {
  int processors = 0;
  const cudaError_t error =
      cudaDeviceGetAttribute(&processors, cudaDevAttrMultiProcessorCount, device);
  if (error != cudaSuccess) return error;
  const int64_t slots = int64_t(processors) * kCtasPerSm<T>;
  const int64_t map_height = a.height - 2 * a.inset;
  plan.map_columns = parts((a.width - 2 * a.inset) * a.channels, kColumns);
  plan.map_height = rows_of(plan.map_columns, map_height, slots);
  plan.map_rows = parts(map_height, plan.map_height);
  plan.image_columns = parts(a.width * a.channels, kColumns);
  plan.image_height = rows_of(plan.image_columns, a.height, slots);
  plan.image_rows = parts(a.height, plan.image_height);
  return cudaSuccess;
}

template <typename T>
cudaError_t ssim(const SsimArgs<T>& a, const SsimPlan& plan, T* slopes, double* sums,
                 cudaStream_t stream) {
  if (a.channels == 3) return launch<T, 3>(a, plan, slopes, sums, stream);
  if (a.channels == 1) return launch<T, 1>(a, plan, slopes, sums, stream);
  return launch<T, 0>(a, plan, slopes, sums, stream);
}

template cudaError_t ssim_plan(const SsimArgs<float>&, int, SsimPlan&);
template cudaError_t ssim_plan(const SsimArgs<double>&, int, SsimPlan&);
template cudaError_t ssim(const SsimArgs<float>&, const SsimPlan&, float*, double*, cudaStream_t);
template cudaError_t ssim(const SsimArgs<double>&, const SsimPlan&, double*, double*, cudaStream_t);

}  // namespace gsf::cuda
