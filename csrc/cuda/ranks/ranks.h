// One scene on several ranks on CUDA devices, one each or several on one (docs/theory/ranks.md).
//
// A rank has its points, its homes and its node values for itself, and a copy of the lists of
// blocks, in which slots and sites have the same numbers everywhere. The view of all, on the first
// device, has no points; it makes those lists at a build.
//
// Sums of nodes are whole numbers, so whoever adds to a node that others hold too adds to theirs as
// well, in whatever order. After that, and after a step, all wait for all; then each rank reads
// what the others tell and ends the step for itself, with the same result.
#pragma once

#include <algorithm>

#include "cuda/solver/launch.h"

namespace gsf::cuda {

// Ranks and where they work. Views and `peers` of each lie in memory of its device.
template <typename T>
struct Fleet {
  int count;                   // ranks
  const SolverView<T>* views;  // [count + 1] on the host; the last is of all
  const int* device;           // [count + 1]
  const cudaStream_t* stream;  // [count + 1] one for each device
  const cudaEvent_t* event;    // [count + 1] likewise

  const SolverView<T>& all() const { return views[count]; }
  // The streams of all devices begin after that of the view of all, and end before it goes on.
  cudaError_t fork() const {
    cudaSetDevice(device[count]);
    cudaError_t error = cudaEventRecord(event[count], stream[count]);
    for (int r = 0; r < count && error == cudaSuccess; ++r) {
      if (!first_there(r) || device[r] == device[count]) continue;
      cudaSetDevice(device[r]);
      error = cudaStreamWaitEvent(stream[r], event[count], 0);
    }
    return error;
  }
  cudaError_t join() const {
    cudaError_t error = cudaSuccess;
    for (int r = 0; r < count && error == cudaSuccess; ++r) {
      if (!first_there(r) || device[r] == device[count]) continue;
      cudaSetDevice(device[r]);
      error = cudaEventRecord(event[r], stream[r]);
      cudaSetDevice(device[count]);
      if (error == cudaSuccess) error = cudaStreamWaitEvent(stream[count], event[r], 0);
    }
    return error;
  }
  // All of them go on when all have come here.
  cudaError_t meet() const {
    if (std::all_of(device, device + count, [&](int d) { return d == device[count]; }))
      return cudaSuccess;  // one stream for all
    for (int r = 0; r <= count; ++r) {
      if (!first_there(r)) continue;
      cudaSetDevice(device[r]);  // a default stream is that of the device at hand
      const cudaError_t error = cudaEventRecord(event[r], stream[r]);
      if (error != cudaSuccess) return error;
    }
    for (int r = 0; r <= count; ++r) {
      if (!first_there(r)) continue;
      cudaSetDevice(device[r]);
      for (int q = 0; q <= count; ++q) {
        if (!first_there(q) || device[q] == device[r]) continue;
        const cudaError_t error = cudaStreamWaitEvent(stream[r], event[q], 0);
        if (error != cudaSuccess) return error;
      }
    }
    return cudaSuccess;
  }
  // f(view, stream) of every rank, on its device.
  template <typename F>
  void each(const F& f) const {
    for (int r = 0; r < count; ++r) {
      cudaSetDevice(device[r]);
      f(views[r], stream[r]);
    }
  }
  template <typename F>
  void of_all(const F& f) const {
    cudaSetDevice(device[count]);
    f(views[count], stream[count]);
  }

  // The first rank on the device of the view of all.
  int beside_all() const {
    return static_cast<int>(std::find(device, device + count, device[count]) - device);
  }

 private:
  // Whether r is the first rank on its device.
  bool first_there(int r) const {
    for (int q = 0; q < r; ++q)
      if (device[q] == device[r]) return false;
    return true;
  }
};

// Starts the clocks as that of all says, and takes the stress of the first step into the slopes.
template <typename T>
cudaError_t ranks_prime(const Fleet<T>& fleet, int law_set);
// Builds blocks when the clock asks for them, and cuts anew.
template <typename T>
cudaError_t ranks_build(const Fleet<T>& fleet);
template <typename T>
cudaError_t ranks_step(const Fleet<T>& fleet, int law_set);

}  // namespace gsf::cuda
