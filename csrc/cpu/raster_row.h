// How the CPU keeps a projected splat: one row of `splats` per (camera, Gaussian) in the order of
// the inputs. With up to six features in float32 a row is one cache line.
//
// The conic is kept as a sum of squares: power / ln 2 = across^2 + down^2 with
// across = kAcross (dx - kSlope dy), down = kDown dy. Neither cancels, however thin the splat is,
// and on a row of pixels only `across` changes.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>

#include "core/raster.h"

namespace gsf::raster_cpu {

constexpr int kTileEdge = 16;  // [px]
constexpr double kLog2E = 1.4426950408889634;

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

// Writes the header and returns the tiles.
template <typename T>
inline TileBox store_splat(const RasterArgs<T>& a, const Splat<T>& s, T* row) {
  const PixelBox tiles =
      tile_box(splat_box(s.x, s.y, s.extent_x, s.extent_y, a.width, a.height), kTileEdge);
  const auto narrow = [](int v) { return static_cast<uint16_t>(v); };
  const TileBox box{narrow(tiles.x0), narrow(tiles.y0), narrow(tiles.x1), narrow(tiles.y1)};
  const T half = T(0.5 * kLog2E);
  row[kX] = s.x;
  row[kY] = s.y;
  row[kAcross] = std::sqrt(half * s.a);
  row[kInverseAcross] = T(1) / row[kAcross];
  row[kSlope] = -s.b / s.a;
  row[kDown] = std::sqrt(half / s.cov_c);  // c - b^2 / a without the difference
  row[kLogOpacity] = std::log2(s.opacity);
  row[kReach] = T(kLog2E) * s.cutoff;
  std::memcpy(row + kBox, &box, sizeof box);
  return box;
}

// Sums of v across, v down, v across^2, v across down, v down^2, v over the pixels, with
// v = dL/d ln alpha, become gradients of centre, covariance and opacity as from
// moments_to_gradient. The conic times the distance to the centre, whose products these are, is
// linear in across and down.
template <typename T>
inline void row_gradient(const T* moment, const T* row, T* g) {
  const T x = T(2 / kLog2E) * row[kAcross], y = T(2 / kLog2E) * row[kDown], z = -row[kSlope] * x;
  const T xx = x * moment[2], xy = x * moment[3], yy = y * moment[4];
  g[0] = x * moment[0];
  g[1] = z * moment[0] + y * moment[1];
  g[2] = T(0.5) * x * xx;
  g[3] = T(0.5) * (z * xx + y * xy);
  g[4] = T(0.5) * (z * z * moment[2] + 2 * y * z * moment[3] + y * yy);
  g[5] = moment[5] / std::exp2(row[kLogOpacity]);
}

}  // namespace gsf::raster_cpu
