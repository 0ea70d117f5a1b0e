// Plain argument structs of the material kernels: pointers, sizes, scalars. Shared by the CPU loops
// and the CUDA launchers; every pointer is contiguous and lives on the kernel's device.
#pragma once

#include <cstdint>

namespace gsf {

template <typename T>
struct PolarArgs {
  int64_t count;
  const T* deformation;  // [count, 9]
  T lo, hi;              // stretch bounds [-]
  T* rotation;           // [count, 9]
  T* clamped;            // [count, 9]
};

template <typename T>
struct ReturnMappingArgs {
  int64_t count;
  const T* strain;          // [count, 6] b - I
  const T* alpha;           // [count]
  const T* increment;       // [count, 9] dt grad v
  int64_t rows;             // rows of law and params
  const int32_t* law;       // [rows]
  const T* params;          // [rows, 8]
  const int32_t* material;  // [count] row per particle, or null: row 0, or row i when rows == count
  T k, epsilon;
  bool implicit_alpha;
  T dt;           // [s], for viscosity: grad v = increment / dt
  T* strain_out;  // [count, 6]
  T* alpha_out;   // [count]
  T* stress_out;  // [count, 6] Kirchhoff [Pa]
  int32_t* info;  // [4] plastic, guarded, inverted, invalid particles; zeroed by the caller
};

// Axes of Gaussians from covariances, and of Gaussians carried by a deformation (core/carry.h).
template <typename T>
struct CovarianceAxesArgs {
  int64_t count;
  const T* covariance;  // [count, 6]
  T* quats;             // [count, 4]
  T* scales;            // [count, 3]
};

template <typename T>
struct CarryAxesArgs {
  int64_t count;
  const T* rest_quats;   // [count, 4]
  const T* rest_scales;  // [count, 3]
  const T* map;          // [count, 9]
  const T* rotation;     // [count, 9]
  T rigid;               // largest entry of map - rotation that still counts as rigid
  T* quats;
  T* scales;
};

template <typename T>
struct CarryPlaceArgs {
  int64_t count, points;  // places, material points
  int near_count;         // K
  const T* places;        // [count, 3] at rest
  const int64_t* owner;   // [count] point of each
  const int64_t* near;    // [points, K] neighbours of a point
  const bool* parted;     // [points, K]
  const T* rest;          // [points, 3]
  const T* position;      // [points, 3]
  const T* map;           // [points, 9]
  const T* width;         // [points] of the blend [m]
  T* means;               // [count, 3]
  T* blend;               // [count, 9]
};

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
