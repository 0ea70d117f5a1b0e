// How the CUDA rasterizer keeps splats: 8 numbers of geometry per splat, then, behind those of all
// splats, the features. And which tiles of the lists a splat touches, row of tiles by row of tiles.
#pragma once

#include "cuda/raster/launch.h"

namespace gsf::cuda {

constexpr uint32_t kCulledKey = 0xffffffffu;

template <typename T>
struct alignas(16) SplatGeometry {
  T x, y;
  SplatConic<T> conic;
  T opacity;  // after antialiasing; 0 marks a splat that cannot be seen
  T extent_x, extent_y;
};

template <typename T>
GSF_HOST_DEVICE const SplatGeometry<T>* splat_geometry(const RasterArgs<T>& a) {
  return reinterpret_cast<const SplatGeometry<T>*>(a.splats);
}
template <typename T>
GSF_HOST_DEVICE T* splat_feature_rows(const RasterArgs<T>& a) {
  return a.splats + kGeometry * a.splat_count();
}

// dy / dx of the line through the middles of the support on all pixel columns: slope var_y / var_x.
template <typename T>
GSF_HOST_DEVICE T vertical_slope(const SplatGeometry<T>& g) {
  const T ratio = g.extent_y / g.extent_x;
  return g.conic.slope * ratio * ratio;
}

// Rows of tiles [y0, y1) that a splat may touch, and its pixel box.
template <typename T>
struct SplatBands {
  PixelBox pixels;
  int y0, y1;
  T slope_x, slope_y, half_width, inverse_extent;

  GSF_HOST_DEVICE SplatBands(const SplatGeometry<T>& g, const RasterArgs<T>& a) {
    using std::sqrt;
    pixels = splat_box(g.x, g.y, g.extent_x, g.extent_y, a.width, a.height);
    y0 = pixels.y0 / a.tile;
    y1 = (pixels.y1 + a.tile - 1) / a.tile;
    // On the line dy the support is slope dy +- half_width sqrt(1 - (dy / extent_y)^2); a little
    // slack absorbs rounding.
    slope_x = g.conic.slope;
    slope_y = vertical_slope(g);
    const T cutoff = T(kLog2E) * splat_cutoff(g.opacity);
    half_width = sqrt(max(cutoff, T(0))) / g.conic.across * T(1.0001) + T(1e-3);
    inverse_extent = T(1) / (g.extent_y + T(1e-3));
  }

  // Columns of tiles [*first, *last) of tile row `row`.
  GSF_HOST_DEVICE void columns(const SplatGeometry<T>& g, const RasterArgs<T>& a, int row,
                               int* first, int* last) const {
    using std::ceil;
    using std::floor;
    using std::sqrt;
    const T top = T(row * a.tile) + T(0.5) - g.y, bottom = top + T(a.tile - 1);
    // Where the support reaches farthest to the right; to the left it is the opposite point.
    const T turn = slope_y * g.extent_x;
    const T d0 = max(top, -g.extent_y), d1 = min(bottom, g.extent_y);
    const T t0 = d0 * inverse_extent, t1 = d1 * inverse_extent;
    const T h0 = half_width * sqrt(max(T(1.0001) - t0 * t0, T(0)));
    const T h1 = half_width * sqrt(max(T(1.0001) - t1 * t1, T(0)));
    const T c0 = slope_x * d0, c1 = slope_x * d1;
    const T high = turn >= top && turn <= bottom ? g.extent_x : max(c0 + h0, c1 + h1);
    const T low = -turn >= top && -turn <= bottom ? -g.extent_x : min(c0 - h0, c1 - h1);
    const T left = clamp(ceil(g.x + low - T(0.5)), T(pixels.x0), T(pixels.x1));
    const T right = clamp(floor(g.x + high - T(0.5)) + T(1), T(pixels.x0), T(pixels.x1));
    *first = static_cast<int>(left) / a.tile;
    *last = left < right ? (static_cast<int>(right) + a.tile - 1) / a.tile : *first;
  }
};

// The tiles of one splat in 64 bits. Few: a mask over 6x6 tiles and where those stand. Many: only
// their number, and who lists them asks SplatBands again.
class TileCode {
 public:
  static constexpr int kEdge = 6;

  template <typename T>
  GSF_HOST_DEVICE static uint64_t of(const SplatGeometry<T>& g, const RasterArgs<T>& a) {
    const SplatBands<T> bands(g, a);
    const int left = bands.pixels.x0 / a.tile, right = (bands.pixels.x1 + a.tile - 1) / a.tile;
    const bool few = right - left <= kEdge && bands.y1 - bands.y0 <= kEdge;
    uint64_t mask = 0, count = 0;
    for (int row = bands.y0; row < bands.y1; ++row) {
      int first, last;
      bands.columns(g, a, row, &first, &last);
      count += static_cast<uint32_t>(last - first);
      if (few && first < last)
        mask |= uint64_t((1u << (last - left)) - (1u << (first - left)))
                << (kEdge * (row - bands.y0));
    }
    return few ? mask | uint64_t(left) << kX | uint64_t(bands.y0) << kY : count | kMany;
  }
  __device__ static bool many(uint64_t code) { return code & kMany; }
  __device__ static uint64_t mask(uint64_t code) { return code & ((uint64_t(1) << kX) - 1); }
  // First column and row of the mask.
  __device__ static int x(uint64_t code) { return code >> kX & kMostTiles; }
  __device__ static int y(uint64_t code) { return code >> kY & kMostTiles; }
  __device__ static uint32_t count(uint64_t code) {
    return many(code) ? static_cast<uint32_t>(code) : __popcll(mask(code));
  }

 private:
  static constexpr int kX = kEdge * kEdge, kY = kX + 12;
  static constexpr int kMostTiles = 4095;  // of a side; images are at most 65536 wide
  static constexpr uint64_t kMany = uint64_t(1) << 63;
};

}  // namespace gsf::cuda
