// Plain argument structs of the deformation kernels: pointers, sizes, scalars. Shared by the CPU
// loops and the CUDA launchers; every pointer is contiguous and lives on the kernel's device.
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

// Axes of Gaussians from covariances, and of Gaussians carried by a deformation (carry.h).
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

// Splats cut where cells of points border on each other, and Gaussians cut by planes (cut.h).
template <typename T>
struct CutAtCellsArgs {
  int64_t count, points;  // splats, material points
  int near_count;         // K
  const T* means;         // [count, 3]
  const T* quats;         // [count, 4]
  const T* scales;        // [count, 3]
  const int64_t* owner;   // [count] point of each
  const int64_t* near;    // [points, K] neighbours of a point
  const bool* opened;     // [points, K] which of them have moved away
  const T* rest;          // [points, 3]
  T slack;                // deviations by which cuts stay outside
  bool* cut;              // [count]
  T* new_means;           // [count, 3]
  T* new_quats;           // [count, 4]
  T* new_scales;          // [count, 3]
};

template <typename T>
struct CutByPlanesArgs {
  int64_t count, planes;
  const T* means;        // [count, 3]
  const T* whole;        // [count, 3] from where the distances count
  const T* covariance;   // [count, 6]
  const int64_t* first;  // [count + 1] first plane of each
  const T* normal;       // [planes, 3] unit
  const T* distance;     // [planes]
  const T* share;        // [planes] how far each cuts, 0 to 1
  T* new_means;          // [count, 3]
  T* quats;              // [count, 4]
  T* scales;             // [count, 3]
};

}  // namespace gsf
