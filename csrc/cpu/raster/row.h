// How the CPU keeps a projected splat: one row of `splats` per (camera, Gaussian) in the order of
// the inputs. With up to six features in float32 a row is one cache line.
//
// The conic is kept as a sum of squares (SplatConic): on a row of pixels only `across` changes.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>

#include "core/raster/raster.h"

namespace gsf::raster_cpu {

constexpr int kTileEdge = 16;  // [px]

// Row of `splats`: this header, then the blended features (colours, normal, depth).
enum SplatField : int {
  kX,
  kY,
  kAcross,         // [1/px]
  kInverseAcross,  // [px]
  kSlope,          // of the line through the middles of the support on all pixel rows
  kDown,           // [1/px]
  kLogOpacity,     // base 2
  kReach,          // largest across^2 + down^2 that still contributes
  kBox,            // a TileBox in the bytes of two numbers
  kFeatures = kBox + 2
};

constexpr int row_stride(int features) { return (kFeatures + features + 3) / 4 * 4; }

// The tiles [x0, x1) x [y0, y1) that a splat's pixel box touches; empty for one not to be seen.
struct TileBox {
  uint16_t x0, y0, x1, y1;

  int width() const { return x1 - x0; }
  int64_t count() const { return int64_t(x1 - x0) * (y1 - y0); }
  bool holds(int x, int y) const { return x >= x0 && x < x1 && y >= y0 && y < y1; }
};

template <typename T>
inline TileBox load_box(const T* row) {
  TileBox box;
  std::memcpy(&box, row + kBox, sizeof box);
  return box;
}

}  // namespace gsf::raster_cpu
