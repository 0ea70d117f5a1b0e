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

// Rotations in two forms, and products of them (turn.h).
template <typename T>
struct TurnArgs {
  int64_t count;
  const T* first;   // [count, 4] or [count, 9]
  const T* second;  // [count, 4]; products only
  T* out;           // [count, 9] or [count, 4]
};

// Links between neighbouring points, at a moment (link.h).
template <typename T>
struct LinkStatesArgs {
  int64_t count, points;      // links, points
  int near_count;             // K; count = points * K
  const T* position;          // [points or more, 3]
  const T* apart;             // [points, K] lengths at rest
  const int64_t* near;        // [points, K] neighbours of a point
  const int32_t* piece;       // [points or more], -1 for none
  const bool* broken;         // [points or more] or null
  const bool* parted_before;  // [points, K] or null, and then the next one too
  const bool* opened_before;  // [points, K]
  const bool* none;           // [points, K] what stands for no link
  T together, loose;          // ratios at which links within a piece and others part
  T open, back;               // ratio of a gap; share of a ratio down to which it stays so
  bool* parted;               // [points, K]
  bool* opened;               // [points, K]
  T* ratio;                   // [points, K]
};

// Flat Gaussians on the faces of cracks (faces.h); lengths of a fit are in pitches.
template <typename T>
struct FaceFit {
  T layer, overlap, width, inset, rim, edge, narrowest, steep, thickness;
};
constexpr int kFaceFit = 9;

template <typename T>
struct FaceArgs {
  int64_t count;  // of rows, or of elements
  int64_t sites, points;
  int near_count;  // K
  FaceFit<T> fit;
  const int64_t* rows;    // [count] sites
  const int64_t* column;  // [count] neighbour of each element's face, K for a rim
  const T* means;         // [sites, 3]
  const int64_t* owner;   // [sites] own point of each
  const T* pitch;         // [sites] distance between sites [m]
  const T* outward;       // [sites, 3] to the skin
  const T* depth;         // [sites] below the skin [m]
  const int64_t* near;    // [points, K] neighbours of a point
  const bool* opened;     // [points, K] which of them have moved away
  const T* rest;          // [points, 3]
  bool* has;              // [count, K + 1]
  int64_t* rival;         // [count] the neighbour of the face, or of the one that a rim is of
  T* out_means;           // [count, 3]
  T* out_quats;           // [count, 4]
  T* out_scales;          // [count, 3]
  T* out_normals;         // [count, 3]
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
