// CUDA back end of the resident solver: enqueues rounds of (blocks if wanted, then steps). Nothing
// here waits for the device; the clock says afterwards what happened.
#include <cstring>
#include <mutex>

#include "cuda/solver/launch.h"
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

struct SolverCuda {
  using Scope = CudaScope;
  static constexpr bool kHasRanks = false;
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
