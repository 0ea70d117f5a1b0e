// How the CPU keeps a projected splat: one row of `splats` per (camera, Gaussian) in the order of
// the inputs. With three or four features in float32 a row is one cache line.
#pragma once

#include <algorithm>
#include <cstdint>
#include <cstring>

#include "core/raster.h"

namespace gsf::raster_cpu {

constexpr int kTileEdge = 16;  // [px]

// Row of `splats`: this header, then the blended features (colours, normal, depth).
enum SplatField : int {
  kX,
  kY,
  kConicA,
  kConicB,
  kConicC,
  kOpacity,
  kCutoff,
  kHalfWidth,      // of the support on the pixel row through its centre [px]
  kSlope,          // of the line through the middles of the support on all pixel rows
  kInverseExtent,  // 1 / half height of the support [1/px]
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

// Writes the header and returns the tiles.
template <typename T>
inline TileBox store_splat(const RasterArgs<T>& a, const Splat<T>& s, T* row) {
  const PixelBox tiles =
      tile_box(splat_box(s.x, s.y, s.extent_x, s.extent_y, a.width, a.height), kTileEdge);
  const auto narrow = [](int v) { return static_cast<uint16_t>(v); };
  const TileBox box{narrow(tiles.x0), narrow(tiles.y0), narrow(tiles.x1), narrow(tiles.y1)};
  row[kX] = s.x;
  row[kY] = s.y;
  row[kConicA] = s.a;
  row[kConicB] = s.b;
  row[kConicC] = s.c;
  row[kOpacity] = s.opacity;
  row[kCutoff] = s.cutoff;
  row[kHalfWidth] = std::sqrt(2 * s.cutoff / s.a);
  row[kSlope] = -s.b / s.a;
  row[kInverseExtent] = T(1) / (s.extent_y + T(1e-3));
  std::memcpy(row + kBox, &box, sizeof box);
  return box;
}

}  // namespace gsf::raster_cpu
