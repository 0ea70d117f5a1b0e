// One 16x16 tile on one core: which 8-pixel blocks of the tile a splat reaches, its weight in a
// block, the forward blend. The adjoint (grad.h) walks front to back through the same
// `BlockWalk::weigh`, so that thresholds, early stops and sibling skips agree exactly.
#pragma once

#include <algorithm>

#include "cpu/raster/pack.h"
#include "cpu/raster/row.h"

namespace gsf::raster_cpu {

template <typename T>
inline constexpr int kLanes = cpu::Pack<T>::kLanes;
// Blocks of kLanes pixels in a row; block index = column * kTileEdge + row.
template <typename T>
inline constexpr int kColumns = kTileEdge / kLanes<T>;
template <typename T>
inline constexpr int kBlocks = kTileEdge * kColumns<T>;

// Pixel centres 0.5, 1.5, ... of one block.
template <typename T>
inline Pack<T> lane_centres() {
  Pack<T> v{};
  for (int i = 0; i < kLanes<T>; ++i) v[i] = T(i) + T(0.5);
  return v;
}

// A splat on the rows of pixels of one tile.
template <typename T>
struct SplatRows {
  alignas(32) T start[kTileEdge];  // `across` at the tile's left edge
  alignas(32) T down[kTileEdge];
  alignas(32) T peak[kTileEdge];  // log2 of the opacity at across = 0

  // Fills the rows and returns the bit set of the blocks whose pixels may lie in the support.
  // Conservative (a little slack); the exact test is per pixel.
  inline uint64_t place(const T* splat, T tile_x, T tile_y) {
    uint64_t bits = 0;
    const T reach = splat[kReach] * T(1.0001) + T(1e-3);
    for (int r = 0; r < kTileEdge; r += kLanes<T>) {
      const Pack<T> dy = lane_centres<T>() + (tile_y + T(r) - splat[kY]);
      const Pack<T> below = splat[kDown] * dy, square = below * below;
      const Pack<T> middle = splat[kSlope] * dy + (splat[kX] - tile_x);
      const Pack<T> rest = reach - square;
      const Pack<T> half =
          splat[kInverseAcross] * pack_sqrt<T>(pack_max<T>(rest, Pack<T>{})) + T(1e-3);
      store_pack(start + r, -splat[kAcross] * middle);
      store_pack(down + r, below);
      store_pack(peak + r, splat[kLogOpacity] - square);
      const Pack<T> low = middle - half, high = middle + half;
      for (int column = 0; column < kColumns<T>; ++column) {
        const T x0 = T(column * kLanes<T>) + T(0.5);
        const auto reached = (high >= x0) & (low <= x0 + T(kLanes<T> - 1)) & (rest > T(0));
        bits |= static_cast<uint64_t>(mask_bits(reached)) << (column * kTileEdge + r);
      }
    }
    return bits;
  }
};

// Transmittance of the tile's pixels and the sibling ring. A pixel that has stopped, or lies off
// the image, carries a negative transmittance: no later test can pass then.
template <typename T, bool kGroups>
struct BlockWalk {
  alignas(32) Pack<T> transmittance[kBlocks<T>];
  PackMask<T> ring[kGroups ? kSiblingRing : 1][kGroups ? kBlocks<T> : 1];
  uint64_t alive = 0;  // blocks with a pixel that still takes light

  void reset(int columns_left, int rows_left) {
    alive = 0;
    const Pack<T> centre = lane_centres<T>();
    for (int block = 0; block < kBlocks<T>; ++block) {
      const int column = block / kTileEdge, row = block % kTileEdge;
      const T left = T(columns_left - column * kLanes<T>);
      const bool inside = row < rows_left && left > T(0);
      transmittance[block] = inside ? (centre < left ? splat_pack<T>(T(1)) : splat_pack<T>(T(-1)))
                                    : splat_pack<T>(T(-1));
      alive |= static_cast<uint64_t>(inside) << block;
    }
    if constexpr (kGroups)
      for (auto& slot : ring)
        for (auto& block : slot) block = PackMask<T>{} - 1;
  }

  struct Weight {
    Pack<T> across;
    Pack<T> alpha;   // capped
    Pack<T> before;  // transmittance in front of the splat
    Pack<T> weight;  // alpha * before where it contributes, else 0
    PackMask<T> keep;
    PackMask<T> open;  // contributes and the cap does not bind
  };

  // Weight of the splat in a block; advances transmittance, ring and the alive set.
  inline Weight weigh(const T* splat, const SplatRows<T>& rows, int group, int block) {
    Weight r;
    const int column = block / kTileEdge, row = block % kTileEdge;
    const Pack<T> x = lane_centres<T>() + T(column * kLanes<T>);
    r.across = splat[kAcross] * x + rows.start[row];
    const Pack<T> level = rows.peak[row] - r.across * r.across;
    const Pack<T> raw = exp2_pack(level);
    r.alpha = pack_min<T>(raw, splat_pack<T>(T(kMaxAlpha)));
    r.before = transmittance[block];
    const Pack<T> after = r.before - r.alpha * r.before;
    PackMask<T> pass = level >= splat[kLogOpacity] - splat[kReach];
    if constexpr (kGroups) {
      if (group >= 0)
        for (int k = 0; k < kSiblingRing; ++k) pass &= ring[k][block] != group;
    }
    r.keep = pass & (after > T(kMinTransmittance));
    r.open = r.keep & (raw < T(kMaxAlpha));
    r.weight = r.keep ? r.alpha * r.before : Pack<T>{};
    const Pack<T> next = r.keep ? after : negative_magnitude<T>(r.before, pass);
    transmittance[block] = next;
    if constexpr (kGroups) {
      if (group >= 0) {
        for (int k = kSiblingRing - 1; k > 0; --k)
          ring[k][block] = r.keep ? ring[k - 1][block] : ring[k][block];
        ring[0][block] = r.keep ? PackMask<T>{} + group : ring[0][block];
      }
    }
    PackMask<T> sign;
    std::memcpy(&sign, &next, sizeof sign);
    if (mask_bits(sign) == (1u << kLanes<T>)-1) alive &= ~(uint64_t(1) << block);
    return r;
  }
};

// Asks for the row of an instance some places ahead: a tile jumps through memory and would wait for
// every row (44 % of the blend's time when measured). Inlined by force: GCC 12 takes a function of
// prefetches alone for one without effect and drops it.
template <typename T>
__attribute__((always_inline)) inline void prefetch_instance(const RasterArgs<T>& a,
                                                             const int32_t* first_slot, int32_t e,
                                                             int32_t end) {
  constexpr int32_t kAhead = 8;
  if (e + kAhead >= end) return;
  const int64_t s = a.instances[e + kAhead];
  const T* row = a.splats + s * a.stride;
  if (first_slot) __builtin_prefetch(first_slot + s);
  __builtin_prefetch(row);
  __builtin_prefetch(row + a.stride - 1);
}

// The part of a camera's image that a tile covers. `tile` counts the tiles of all cameras.
struct TileArea {
  int camera, column, row;  // of the tile
  int x, y, width, height;  // of its pixels
};

template <typename T>
inline TileArea tile_area(const RasterArgs<T>& a, int64_t tile) {
  const int camera = static_cast<int>(tile / a.tiles()), rest = static_cast<int>(tile % a.tiles());
  const int column = rest % a.tiles_x, row = rest / a.tiles_x;
  const int x = column * kTileEdge, y = row * kTileEdge;
  return {camera,
          column,
          row,
          x,
          y,
          std::min(kTileEdge, a.width - x),
          std::min(kTileEdge, a.height - y)};
}

// Calls f(block, lanes, pixel) for the blocks of a tile that lie on the image: `lanes` of its
// pixels do, the first of which is `pixel`.
template <typename T, typename F>
inline void for_each_block(const RasterArgs<T>& a, const TileArea& area, const F& f) {
  for (int y = 0; y < area.height; ++y)
    for (int x = 0; x < area.width; x += kLanes<T>)
      f(x / kLanes<T> * kTileEdge + y, std::min(kLanes<T>, area.width - x),
        (int64_t(area.camera) * a.height + area.y + y) * a.width + area.x + x);
}

// Place of an instance among those of all splats, which lie splat by splat and row by row over the
// tiles it touches; -1 when the tile is not one of them (the adjoint is handed its lists back and
// trusts nothing).
template <typename T>
inline int64_t instance_slot(const RasterArgs<T>& a, int32_t s, const TileArea& area) {
  const TileBox box = load_box(a.splats + int64_t(s) * a.stride);
  if (!box.holds(area.column, area.row)) return -1;
  const int64_t place =
      int64_t(a.order[s]) + (area.row - box.y0) * box.width() + area.column - box.x0;
  return place < a.instance_count ? place : -1;
}

// Blends one tile and writes its pixels. kF: blended features when known at compile time, else 0.
// `depth` is the camera z of the splats; `slots` (one weight sum per instance) is null unless
// contributions are wanted.
template <typename T, int kF, bool kGroups>
void blend_tile(const RasterArgs<T>& a, int64_t tile, const T* depth, T* slots) {
  const int features = kF ? kF : a.features;
  const TileArea area = tile_area(a, tile);
  const int64_t first = area.camera * a.count;
  const bool has_median = a.median != nullptr;
  BlockWalk<T, kGroups> walk;
  walk.reset(area.width, area.height);
  SplatRows<T> rows;
  alignas(32) Pack<T> sum[kF ? kF : kMaxFeatures][kBlocks<T>];
  // Alpha is the sum of weights: 1 - transmittance would cost thin pixels their precision.
  alignas(32) Pack<T> weights[kBlocks<T>];
  alignas(32) Pack<T> median[kBlocks<T>];
  for (auto& block : weights) block = Pack<T>{};
  for (auto& block : median) block = Pack<T>{};
  for (int f = 0; f < features; ++f)
    for (auto& block : sum[f]) block = Pack<T>{};
  const int32_t end = a.tile_start[tile + 1];
  int32_t e = a.tile_start[tile];
  for (; e < end && walk.alive; ++e) {
    prefetch_instance(a, slots ? a.order : nullptr, e, end);
    const int32_t s = a.instances[e];
    const T* splat = a.splats + int64_t(s) * a.stride;
    int group = -1;
    if constexpr (kGroups) group = a.groups[s - first];
    Pack<T> total{};
    for (uint64_t bits = rows.place(splat, T(area.x), T(area.y)) & walk.alive; bits;
         bits &= bits - 1) {
      const int block = __builtin_ctzll(bits);
      const auto w = walk.weigh(splat, rows, group, block);
      for (int f = 0; f < features; ++f) sum[f][block] += w.weight * splat[kFeatures + f];
      weights[block] += w.weight;
      total += w.weight;
      if (has_median) {
        const auto half = w.keep & (w.before > T(0.5)) & (w.before - w.weight <= T(0.5));
        median[block] = half ? splat_pack<T>(depth[s]) : median[block];
      }
    }
    if (slots) slots[instance_slot(a, s, area)] = pack_sum<T>(total);
  }
  if (slots)
    for (; e < end; ++e) slots[instance_slot(a, a.instances[e], area)] = T(0);

  T background[kMaxChannels];
  for (int c = 0; c < a.channels; ++c) background[c] = a.background_color(area.camera, c);
  for_each_block(a, area, [&](int block, int lanes, int64_t pixel) {
    const Pack<T> before = walk.transmittance[block], left = pack_abs<T>(before);
    const Pack<T> alpha = pack_min<T>(weights[block], splat_pack<T>(T(1)));
    const auto write = [&](const Pack<T>& value, T* out, int step) {
      T lane[kLanes<T>];
      store_pack(lane, value);
      for (int k = 0; k < lanes; ++k) out[k * step] = lane[k];
    };
    write(alpha, a.alpha + pixel, 1);
    for (int c = 0; c < a.channels; ++c)
      write(sum[c][block] + left * background[c], a.image + pixel * a.channels + c, a.channels);
    for (int c = 0; c < a.vectors; ++c)
      write(sum[a.channels + c][block], a.normal + a.vectors * pixel + c, a.vectors);
    if (a.has_depth)
      write(alpha > T(0) ? sum[features - 1][block] / alpha : Pack<T>{}, a.depth + pixel, 1);
    if (has_median) write(median[block], a.median + pixel, 1);
  });
}

}  // namespace gsf::raster_cpu
