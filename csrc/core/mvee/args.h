// Plain argument structs of the ellipsoid kernels: pointers, sizes, scalars. Shared by the CPU
// loops and the CUDA launchers; every pointer is contiguous and lives on the kernel's device.
#pragma once

#include <cstdint>

namespace gsf {

template <typename T>
struct MveeArgs {
  int64_t batch, count;  // fits, points per fit
  const T* points;       // [batch, count, 3]
  double tolerance;
  int max_iterations;
  T* center;  // [batch, 3]
  T* shape;   // [batch, 9]
};

template <typename T>
struct MveeLensArgs {
  int64_t batch;
  const T* mean_a;        // [batch, 3]
  const T* covariance_a;  // [batch, 6]
  const T* mean_b;
  const T* covariance_b;
  double radius;  // k_sigma
  double flat;    // least ratio of the semi-axes of an overlap
  T* mean;        // [batch, 3]
  T* covariance;  // [batch, 6]
  bool* overlap;  // [batch]
  // [6], zero at first: for each kind of LensFault, batch minus the first row that has it.
  int64_t* faults;
};

}  // namespace gsf
