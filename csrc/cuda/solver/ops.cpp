// CUDA back end of the resident solver: enqueues rounds of (blocks if wanted, then steps). Nothing
// here waits for the device; the clock says afterwards what happened.
#include <cstdlib>
#include <cstring>
#include <map>
#include <mutex>

#include "cuda/ranks/ranks.h"
#include "cuda/stream.h"
#include "host/solver.h"

namespace gsf {
namespace {

// A round as a CUDA graph, launched again and again: one launch for two dozen kernels, and shorter
// gaps between them. It is captured on a stream of its own, since the default stream cannot be, and
// kept while the state stays where it is.
template <typename T>
class Round {
 public:
  void launch(const SolverView<T>& s, int law_set, int64_t steps, int64_t rounds, int device,
              cudaStream_t caller) {
    const std::lock_guard<std::mutex> lock(mutex_);
    if (stream_ == nullptr || device != device_) start(device);
    if (exec_ == nullptr || law_set != law_set_ || steps != steps_ ||
        std::memcmp(&s, &view_, sizeof view_) != 0)
      capture(s, law_set, steps);
    check_cuda("solver_run", cudaEventRecord(event_, caller));
    check_cuda("solver_run", cudaStreamWaitEvent(stream_, event_, 0));
    for (int64_t r = 0; r < rounds; ++r) check_cuda("solver_run", cudaGraphLaunch(exec_, stream_));
    check_cuda("solver_run", cudaEventRecord(event_, stream_));
    check_cuda("solver_run", cudaStreamWaitEvent(caller, event_, 0));
  }

 private:
  void start(int device) {
    stream_ = nullptr;  // those of another device stay with it
    exec_ = nullptr;
    check_cuda("solver_run", cudaStreamCreateWithFlags(&stream_, cudaStreamNonBlocking));
    check_cuda("solver_run", cudaEventCreateWithFlags(&event_, cudaEventDisableTiming));
    device_ = device;
  }

  void capture(const SolverView<T>& s, int law_set, int64_t steps) {
    if (exec_ != nullptr) check_cuda("solver_run", cudaGraphExecDestroy(exec_));
    exec_ = nullptr;
    // Only launches are captured. Relaxed: a kernel's first launch loads it, which may allocate,
    // and other threads go on meanwhile.
    check_cuda("solver_run", cudaStreamBeginCapture(stream_, cudaStreamCaptureModeRelaxed));
    cudaError_t error = cuda::solver_build(s, stream_);
    for (int64_t i = 0; i < steps && error == cudaSuccess; ++i)
      error = cuda::solver_step(s, law_set, stream_);
    cudaGraph_t graph = nullptr;
    const cudaError_t ended = cudaStreamEndCapture(stream_, &graph);
    check_cuda("solver_run", error);
    check_cuda("solver_run", ended);
    error = cudaGraphInstantiate(&exec_, graph, 0);
    cudaGraphDestroy(graph);
    check_cuda("solver_run", error);
    std::memcpy(&view_, &s, sizeof view_);
    law_set_ = law_set;
    steps_ = steps;
  }

  std::mutex mutex_;
  cudaStream_t stream_ = nullptr;
  cudaEvent_t event_ = nullptr;
  cudaGraphExec_t exec_ = nullptr;
  SolverView<T> view_{};
  int law_set_ = -1, device_ = -1;
  int64_t steps_ = 0;
};

// The ranks with their devices for one call: the views know each other, the devices may reach each
// other's memory, and each works in the stream that is torch's there.
template <typename T>
class Ranks {
 public:
  // `views` and one tensor of each on its device; the last are of all.
  Ranks(std::vector<SolverView<T>> views, const std::vector<Tensor>& like)
      : views_(std::move(views)) {
    for (const Tensor& t : like) device_.push_back(t.get_device_index());
    for (const int d : device_)
      for (const int other : device_) reach(d, other);
    for (size_t r = 0; r < views_.size(); ++r) {
      views_[r].rank = static_cast<int32_t>(r);
      void* stream = nullptr;
      TORCH_ERROR_CODE_CHECK(aoti_torch_get_current_cuda_stream(device_[r], &stream));
      stream_.push_back(static_cast<cudaStream_t>(stream));
      event_.push_back(event_on(device_[r]));
    }
    for (size_t r = 0; r < views_.size(); ++r) {
      check_cuda("solver_ranks", cudaSetDevice(device_[r]));
      check_cuda("solver_ranks", cudaMemcpyAsync(const_cast<SolverView<T>*>(views_[r].peers),
                                                 views_.data(), views_.size() * sizeof views_[0],
                                                 cudaMemcpyHostToDevice, stream_[r]));
    }
    const cuda::Fleet<T> all = fleet();
    check_cuda("solver_ranks", all.meet());
  }

  cuda::Fleet<T> fleet() const {
    return {static_cast<int>(views_.size()) - 1, views_.data(), device_.data(), stream_.data(),
            event_.data()};
  }
  const std::vector<SolverView<T>>& views() const { return views_; }
  const std::vector<int>& devices() const { return device_; }

 private:
  static void reach(int device, int other) {
    if (device == other) return;
    int can = 0;
    check_cuda("solver_ranks", cudaDeviceCanAccessPeer(&can, device, other));
    STD_TORCH_CHECK(can != 0, "solver: device cuda:", device,
                    " cannot reach the memory of cuda:", other,
                    "; name devices of one host that are linked (nvidia-smi topo -p2p r)");
    int adds = 0;
    check_cuda("solver_ranks", cudaDeviceGetP2PAttribute(&adds, cudaDevP2PAttrNativeAtomicSupported,
                                                         device, other));
    STD_TORCH_CHECK(adds != 0, "solver: device cuda:", device,
                    " cannot add in the memory of cuda:", other,
                    "; name devices that NVLink joins (nvidia-smi topo -p2p a)");
    check_cuda("solver_ranks", cudaSetDevice(device));
    const cudaError_t error = cudaDeviceEnablePeerAccess(other, 0);
    if (error == cudaErrorPeerAccessAlreadyEnabled)
      cudaGetLastError();
    else
      check_cuda("solver_ranks", error);
  }
  static cudaEvent_t event_on(int device) {
    static std::map<int, cudaEvent_t> events;
    static std::mutex mutex;
    const std::lock_guard<std::mutex> lock(mutex);
    cudaEvent_t& event = events[device];
    if (event == nullptr) {
      check_cuda("solver_ranks", cudaSetDevice(device));
      check_cuda("solver_ranks", cudaEventCreateWithFlags(&event, cudaEventDisableTiming));
    }
    return event;
  }

  std::vector<SolverView<T>> views_;
  std::vector<int> device_;
  std::vector<cudaStream_t> stream_;
  std::vector<cudaEvent_t> event_;
};

// A round of several ranks as one CUDA graph over all their devices. It is captured on streams of
// its own, one for each device, that fork from the one of the view of all and join it at the end.
template <typename T>
class RanksRound {
 public:
  void launch(const Ranks<T>& ranks, int law_set, int64_t steps, int64_t rounds) {
    const std::lock_guard<std::mutex> lock(mutex_);
    if (!is_of(ranks, law_set, steps)) capture(ranks, law_set, steps);
    const cuda::Fleet<T> callers = ranks.fleet();
    check_cuda("solver_run_ranks", callers.meet());
    const int all = callers.count;
    check_cuda("solver_run_ranks", cudaSetDevice(callers.device[all]));
    check_cuda("solver_run_ranks", cudaEventRecord(callers.event[all], callers.stream[all]));
    check_cuda("solver_run_ranks", cudaStreamWaitEvent(stream_[all], callers.event[all], 0));
    for (int64_t r = 0; r < rounds; ++r)
      check_cuda("solver_run_ranks", cudaGraphLaunch(exec_, stream_[all]));
    check_cuda("solver_run_ranks", cudaEventRecord(callers.event[all], stream_[all]));
    check_cuda("solver_run_ranks", cudaStreamWaitEvent(callers.stream[all], callers.event[all], 0));
    check_cuda("solver_run_ranks", callers.meet());
  }

 private:
  bool is_of(const Ranks<T>& ranks, int law_set, int64_t steps) const {
    const std::vector<SolverView<T>>& now = ranks.views();
    return exec_ != nullptr && law_set == law_set_ && steps == steps_ &&
           ranks.devices() == device_ && now.size() == views_.size() &&
           std::memcmp(now.data(), views_.data(), now.size() * sizeof now[0]) == 0;
  }

  // One stream and event for each device.
  void start(const std::vector<int>& devices) {
    device_ = devices;
    stream_.clear();
    event_.clear();
    static std::map<int, std::pair<cudaStream_t, cudaEvent_t>> there;
    for (const int device : devices) {
      auto& [stream, event] = there[device];
      if (stream == nullptr) {
        check_cuda("solver_run_ranks", cudaSetDevice(device));
        check_cuda("solver_run_ranks", cudaStreamCreateWithFlags(&stream, cudaStreamNonBlocking));
        check_cuda("solver_run_ranks", cudaEventCreateWithFlags(&event, cudaEventDisableTiming));
      }
      stream_.push_back(stream);
      event_.push_back(event);
    }
  }

  void capture(const Ranks<T>& ranks, int law_set, int64_t steps) {
    if (exec_ != nullptr) check_cuda("solver_run_ranks", cudaGraphExecDestroy(exec_));
    exec_ = nullptr;
    start(ranks.devices());
    const std::vector<SolverView<T>>& views = ranks.views();
    const int all = static_cast<int>(views.size()) - 1;
    const cuda::Fleet<T> fleet{all, views.data(), device_.data(), stream_.data(), event_.data()};
    check_cuda("solver_run_ranks", cudaSetDevice(device_[all]));
    check_cuda("solver_run_ranks",
               cudaStreamBeginCapture(stream_[all], cudaStreamCaptureModeRelaxed));
    cudaError_t error = fleet.fork();
    if (error == cudaSuccess) error = cuda::ranks_build(fleet);
    for (int64_t i = 0; i < steps && error == cudaSuccess; ++i)
      error = cuda::ranks_step(fleet, law_set);
    const cudaError_t joined = fleet.join();
    cudaGraph_t graph = nullptr;
    cudaSetDevice(device_[all]);
    const cudaError_t ended = cudaStreamEndCapture(stream_[all], &graph);
    check_cuda("solver_run_ranks", error);
    check_cuda("solver_run_ranks", joined);
    check_cuda("solver_run_ranks", ended);
    error = cudaGraphInstantiate(&exec_, graph, 0);
    cudaGraphDestroy(graph);
    check_cuda("solver_run_ranks", error);
    views_ = views;
    law_set_ = law_set;
    steps_ = steps;
  }

  std::mutex mutex_;
  std::vector<int> device_;
  std::vector<cudaStream_t> stream_;
  std::vector<cudaEvent_t> event_;
  cudaGraphExec_t exec_ = nullptr;
  std::vector<SolverView<T>> views_;
  int law_set_ = -1;
  int64_t steps_ = 0;
};

struct SolverCuda {
  using Scope = CudaScope;
  static constexpr bool kHasRanks = false;
  template <typename T>
  static void prime_ranks(std::vector<SolverView<T>> views, const std::vector<Tensor>& like,
                          int law_set) {
    const Ranks<T> ranks(std::move(views), like);
    check_cuda("solver_prime_ranks", cuda::ranks_prime(ranks.fleet(), law_set));
  }
  template <typename T>
  static void run_ranks(std::vector<SolverView<T>> views, const std::vector<Tensor>& like,
                        int law_set, int64_t rounds, int64_t steps) {
    const Ranks<T> ranks(std::move(views), like);
    // For comparison, and for tools that do not see into graphs.
    static const char* const graph = std::getenv("GSFLUENT_RANKS_GRAPH");
    if (graph == nullptr || std::strcmp(graph, "0") != 0) {
      static RanksRound<T> all;
      all.launch(ranks, law_set, steps, rounds);
      return;
    }
    const cuda::Fleet<T> fleet = ranks.fleet();
    for (int64_t round = 0; round < rounds; ++round) {
      check_cuda("solver_run_ranks", cuda::ranks_build(fleet));
      for (int64_t i = 0; i < steps; ++i)
        check_cuda("solver_run_ranks", cuda::ranks_step(fleet, law_set));
    }
    check_cuda("solver_run_ranks", fleet.meet());
  }
  template <typename T>
  static void prime(const SolverView<T>& s, int law_set, const Scope& scope) {
    check_cuda("solver_prime", cuda::solver_prime(s, law_set, scope.stream()));
  }
  template <typename T>
  static void run(const SolverView<T>& s, int law_set, int64_t rounds, int64_t steps,
                  const Scope& scope) {
    static Round<T> round;
    round.launch(s, law_set, steps, rounds, scope.index(), scope.stream());
  }
};

}  // namespace
}  // namespace gsf

GSF_REGISTER(CUDA, gsf::SolverOps<gsf::SolverCuda>)
