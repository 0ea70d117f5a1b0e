// CUDA kernels of the enclosing-ellipsoid ops: eight lanes of a warp per point set, one thread per
// overlap.
#include <algorithm>

#include "core/mvee/lens.h"
#include "core/mvee/mvee.h"
#include "cuda/mvee/launch.h"

namespace gsf::cuda {
namespace {

// Eight lanes of a warp; the four teams of a warp go their own ways.
struct OctetTeam {
  unsigned mask = 0xffu << (threadIdx.x & 24);
  __device__ int rank() const { return threadIdx.x % 8; }
  __device__ int size() const { return 8; }
  __device__ void sync() const { __syncwarp(mask); }
  template <typename T>
  __device__ T sum(T x) const {
    for (int offset = 4; offset > 0; offset /= 2) x += __shfl_xor_sync(mask, x, offset);
    return x;
  }
  template <typename T>
  __device__ T largest(T x) const {
    for (int offset = 4; offset > 0; offset /= 2) x = gsf::max(x, __shfl_xor_sync(mask, x, offset));
    return x;
  }
};

constexpr int kSetTeams = 16;              // point sets per block
constexpr size_t kSharedLimit = 48 << 10;  // bytes of shared memory that need no opt-in

// Words of shared memory per set, padded so that the four sets of a warp read from other banks.
template <typename T>
__host__ __device__ int set_words(int64_t count) {
  const int words = static_cast<int>(count) * static_cast<int>(sizeof(FitPoint<T>) / sizeof(T));
  return words + (40 - words % 32) % 32;
}

// Sets of up to kShared points keep their scratch in shared memory; for larger ones it lies in
// `scratch`, one stretch per team, and the teams go through the sets in strides.
template <typename T, bool kShared>
__global__ void __launch_bounds__(8 * kSetTeams)
    mvee_kernel(const MveeArgs<T> a, FitPoint<T>* scratch, int64_t teams) {
  extern __shared__ double shared[];
  const int64_t first = int64_t(blockIdx.x) * kSetTeams + threadIdx.x / 8;
  if (first >= teams) return;
  FitPoint<T>* own = kShared
                         ? reinterpret_cast<FitPoint<T>*>(reinterpret_cast<T*>(shared) +
                                                          (threadIdx.x / 8) * set_words<T>(a.count))
                         : scratch + first * a.count;
  const OctetTeam team;
  for (int64_t i = first; i < a.batch; i += teams) {
    const Ellipsoid<T> fit = mvee_fit(team, a.points + 3 * a.count * i, static_cast<int>(a.count),
                                      own, a.tolerance, a.max_iterations);
    team.sync();
    if (team.rank() != 0) continue;
    for (int c = 0; c < 3; ++c) a.center[3 * i + c] = fit.center[c];
    store_mat3(a.shape + 9 * i, to_mat3(fit.shape));
  }
}

template <typename T>
__device__ void store(const MveeLensArgs<T>& a, int64_t i, const LensResult<T>& r) {
  for (int c = 0; c < 3; ++c) a.mean[3 * i + c] = r.mean[c];
  store_sym3(a.covariance + 6 * i, r.covariance);
  a.overlap[i] = r.overlap;
}

// One thread per pair: closed answers are written, the other pairs queued.
template <typename T>
__global__ void __launch_bounds__(128)
    lens_setup_kernel(const MveeLensArgs<T> a, int64_t begin, int64_t end, double* setups,
                      int64_t stride, int32_t* rows, int32_t* count) {
  const int64_t i = begin + int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i >= end) return;
  const auto vec = [](const T* p) { return Vec3<T>{p[0], p[1], p[2]}; };
  const Vec3<T> mean_a = vec(a.mean_a + 3 * i), mean_b = vec(a.mean_b + 3 * i);
  const Sym3<T> cov_a = load_sym3(a.covariance_a + 6 * i);
  const Sym3<T> cov_b = load_sym3(a.covariance_b + 6 * i);
  const int fault_a = lens_fault(mean_a, cov_a), fault_b = lens_fault(mean_b, cov_b);
  if (fault_a != kSound || fault_b != kSound) {
    const auto report = [&](int fault) {
      atomicMax(reinterpret_cast<unsigned long long*>(a.faults + fault),
                static_cast<unsigned long long>(a.batch - i));
    };
    if (fault_a != kSound) report(fault_a);
    if (fault_b != kSound) report(kLensFaults + fault_b);
    return;
  }
  const LensSetup s = lens_setup(to_double(mean_a), to_double(cov_a), to_double(mean_b),
                                 to_double(cov_b), a.radius, a.flat);
  if (s.kind != LensKind::kGeneral) {
    store(a, i,
          s.kind == LensKind::kNone ? lens_nothing<T>(s)
                                    : lens_gaussian<T>(s.center, s.frame, a.radius));
    return;
  }
  const int32_t slot = atomicAdd(count, 1);
  rows[slot] = static_cast<int32_t>(i - begin);
  double* out = setups + slot;
  const auto put = [&](double x) {
    *out = x;
    out += stride;
  };
  for (int c = 0; c < 3; ++c) put(s.center[c]);
  for (int c = 0; c < 9; ++c) put(s.frame.m[c]);
  for (int c = 0; c < 3; ++c) put(s.half[c]);
  for (const Quadric<double>* q : {&s.a, &s.b}) {
    put(q->w.xx), put(q->w.yy), put(q->w.zz), put(q->w.xy), put(q->w.xz), put(q->w.yz);
    for (int c = 0; c < 3; ++c) put(q->b[c]);
  }
}

// Pairs per block, one thread each, and words of shared memory per pair: an odd number, so that the
// threads of a warp read from different banks.
template <typename T>
inline constexpr int kLensPairs = sizeof(T) == 4 ? 64 : 32;
template <typename T>
inline constexpr int kLensWords = kLensPoints * int(sizeof(FitPoint<T>) / sizeof(T)) + 1;

template <typename T>
__global__ void __launch_bounds__(kLensPairs<T>)
    lens_fit_kernel(const MveeLensArgs<T> a, int64_t begin, const double* setups, int64_t stride,
                    const int32_t* rows, const int32_t* count) {
  __shared__ T scratch[kLensPairs<T> * kLensWords<T>];
  const int slot = blockIdx.x * kLensPairs<T> + threadIdx.x;
  if (slot >= *count) return;
  const double* in = setups + slot;
  const auto field = [&](int f) { return in[f * stride]; };
  const auto quadric = [&](int f) {
    return Quadric<T>{{T(field(f)), T(field(f + 1)), T(field(f + 2)), T(field(f + 3)),
                       T(field(f + 4)), T(field(f + 5))},
                      {T(field(f + 6)), T(field(f + 7)), T(field(f + 8))}};
  };
  const LensFit<T> fit =
      lens_fit(detail::Overlap<T>{quadric(15), quadric(24)},
               reinterpret_cast<FitPoint<T>*>(scratch + threadIdx.x * kLensWords<T>));
  Mat3<double> frame;
  for (int c = 0; c < 9; ++c) frame.m[c] = field(3 + c);
  store(a, begin + rows[slot],
        lens_result(Vec3<double>{field(0), field(1), field(2)}, frame,
                    Vec3<double>{field(12), field(13), field(14)}, fit, a.radius, a.flat));
}

}  // namespace

template <typename T>
int64_t mvee_scratch(const MveeArgs<T>& args) {
  if (kSetTeams * set_words<T>(std::min<int64_t>(args.count, 1 << 16)) * sizeof(T) <= kSharedLimit)
    return 0;
  // At most about 256 MB, at least one team.
  const int64_t most = (int64_t{1} << 28) / (args.count * int64_t(sizeof(FitPoint<T>)));
  return std::max<int64_t>(1, std::min(args.batch, most)) * args.count *
         int64_t(sizeof(FitPoint<T>) / sizeof(T));
}

template <typename T>
cudaError_t mvee(const MveeArgs<T>& args, T* scratch, int64_t size, cudaStream_t stream) {
  if (args.batch == 0) return cudaSuccess;
  const int64_t point = sizeof(FitPoint<T>) / sizeof(T);
  const int64_t teams = size == 0 ? args.batch : size / (point * args.count);
  const unsigned blocks = static_cast<unsigned>((teams + kSetTeams - 1) / kSetTeams);
  FitPoint<T>* own = reinterpret_cast<FitPoint<T>*>(scratch);
  if (size > 0) {
    mvee_kernel<T, false><<<blocks, 8 * kSetTeams, 0, stream>>>(args, own, teams);
  } else {
    const size_t bytes = kSetTeams * set_words<T>(args.count) * sizeof(T);
    mvee_kernel<T, true><<<blocks, 8 * kSetTeams, bytes, stream>>>(args, own, teams);
  }
  return cudaGetLastError();
}

template <typename T>
cudaError_t mvee_lens(const MveeLensArgs<T>& args, double* setups, int32_t* rows, int32_t* count,
                      cudaStream_t stream) {
  const int64_t stride = std::min(args.batch, kLensChunk);
  for (int64_t begin = 0; begin < args.batch; begin += kLensChunk) {
    const int64_t n = std::min(args.batch - begin, kLensChunk);
    const cudaError_t cleared = cudaMemsetAsync(count, 0, sizeof(int32_t), stream);
    if (cleared != cudaSuccess) return cleared;
    lens_setup_kernel<T><<<static_cast<unsigned>((n + 127) / 128), 128, 0, stream>>>(
        args, begin, begin + n, setups, stride, rows, count);
    // The host does not know how many pairs were queued; blocks beyond them leave at once.
    lens_fit_kernel<T><<<static_cast<unsigned>((n + kLensPairs<T> - 1) / kLensPairs<T>),
                         kLensPairs<T>, 0, stream>>>(args, begin, setups, stride, rows, count);
  }
  return cudaGetLastError();
}

template int64_t mvee_scratch(const MveeArgs<float>&);
template int64_t mvee_scratch(const MveeArgs<double>&);
template cudaError_t mvee(const MveeArgs<float>&, float*, int64_t, cudaStream_t);
template cudaError_t mvee(const MveeArgs<double>&, double*, int64_t, cudaStream_t);
template cudaError_t mvee_lens(const MveeLensArgs<float>&, double*, int32_t*, int32_t*,
                               cudaStream_t);
template cudaError_t mvee_lens(const MveeLensArgs<double>&, double*, int32_t*, int32_t*,
                               cudaStream_t);

}  // namespace gsf::cuda
