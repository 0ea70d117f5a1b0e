// One 16x16 tile on one core: which 8-pixel blocks of the tile a splat reaches, its weight in a
// block, the forward blend and its adjoint. Both walk front to back through the same
// `BlockWalk::weigh`, so that thresholds, early stops and sibling skips agree exactly.
#pragma once

#include <algorithm>

#include "core/raster.h"
#include "cpu/raster_pack.h"

namespace gsf::raster_cpu {

template <typename T>
inline constexpr int kLanes = PackOf<T>::kLanes;
// Blocks of kLanes pixels in a row; block index = column * kTile + row.
template <typename T>
inline constexpr int kColumns = kTile / kLanes<T>;
template <typename T>
inline constexpr int kBlocks = kTile * kColumns<T>;

// Pixel centres 0.5, 1.5, ... of one block.
template <typename T>
inline Pack<T> lane_centres() {
  Pack<T> v{};
  for (int i = 0; i < kLanes<T>; ++i) v[i] = T(i) + T(0.5);
  return v;
}

// Bit set of the blocks whose pixels may lie in the support of the splat. Conservative (a little
// slack); the exact test is per pixel. On a row, the support is an interval around
// x - b/a dy with half width sqrt(2 cutoff / a) sqrt(1 - (dy / extent_y)^2).
template <typename T>
inline uint64_t reached_blocks(const T* splat, T tile_x, T tile_y) {
  const T width = std::sqrt(2 * splat[kCutoff] / splat[kConicA]) * T(1.0001) + T(1e-3);
  const T slope = -splat[kConicB] / splat[kConicA];
  const T inverse_extent = T(1) / (splat[kExtentY] + T(1e-3));
  uint64_t bits = 0;
  for (int r = 0; r < kTile; r += kLanes<T>) {
    const Pack<T> dy = lane_centres<T>() + (tile_y + T(r) - splat[kY]);
    const Pack<T> t = dy * inverse_extent;
    const Pack<T> rest = T(1.0001) - t * t;
    const Pack<T> half = width * pack_sqrt<T>(pack_max<T>(rest, Pack<T>{}));
    const Pack<T> centre = splat[kX] + slope * dy;
    const Pack<T> low = centre - half, high = centre + half;
    for (int column = 0; column < kColumns<T>; ++column) {
      const T x0 = tile_x + T(column * kLanes<T>) + T(0.5);
      const auto reached = (high >= x0) & (low <= x0 + T(kLanes<T> - 1)) & (rest > T(0));
      bits |= static_cast<uint64_t>(lane_bits(reached)) << (column * kTile + r);
    }
  }
  return bits;
}

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
      const int column = block / kTile, row = block % kTile;
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
    Pack<T> alpha;   // capped
    Pack<T> before;  // transmittance in front of the splat
    Pack<T> weight;  // alpha * before where it contributes, else 0
    PackMask<T> keep;
    PackMask<T> open;  // contributes and the cap does not bind
    Pack<T> dx;
    T dy;
  };

  // Weight of the splat in a block; advances transmittance, ring and the alive set.
  inline Weight weigh(const T* splat, int group, int block, T tile_x, T tile_y) {
    Weight r;
    const int column = block / kTile, row = block % kTile;
    r.dy = tile_y + T(row) + T(0.5) - splat[kY];
    r.dx = lane_centres<T>() + (tile_x + T(column * kLanes<T>) - splat[kX]);
    const T half_a = T(0.5) * splat[kConicA];
    const Pack<T> power = pack_max<T>(
        r.dx * (half_a * r.dx + splat[kConicB] * r.dy) + T(0.5) * splat[kConicC] * r.dy * r.dy,
        Pack<T>{});
    const Pack<T> raw = splat[kOpacity] * exp_negative(power);
    r.alpha = pack_min<T>(raw, splat_pack<T>(T(kMaxAlpha)));
    r.before = transmittance[block];
    const Pack<T> after = r.before - r.alpha * r.before;
    PackMask<T> pass = power <= splat[kCutoff];
    if constexpr (kGroups) {
      if (group >= 0)
        for (int k = 0; k < kSiblingRing; ++k) pass &= ring[k][block] != group;
    }
    r.keep = pass & (after > T(kMinTransmittance));
    r.open = r.keep & (raw < T(kMaxAlpha));
    r.weight = r.keep ? r.alpha * r.before : Pack<T>{};
    const Pack<T> stopped = r.before < T(0) ? r.before : -r.before;
    const Pack<T> next = r.keep ? after : (pass ? stopped : r.before);
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
    if (lane_bits(sign) == (1u << kLanes<T>)-1) alive &= ~(uint64_t(1) << block);
    return r;
  }
};

// Asks for the row of an instance some places ahead: rows lie in depth order, so that a tile jumps
// through memory and would wait for every one of them (44 % of the blend's time when measured).
// Inlined by force: GCC 12 takes a function of prefetches alone for one without effect and drops
// it.
template <typename T>
__attribute__((always_inline)) inline void prefetch_instance(const RasterArgs<T>& a,
                                                             const int64_t* first_slot, int32_t e,
                                                             int32_t end) {
  constexpr int32_t kAhead = 8;
  if (e + kAhead >= end) return;
  const int64_t rank = a.instances[e + kAhead];
  const T* row = a.splats + rank * a.stride;
  if (first_slot) __builtin_prefetch(first_slot + rank);
  __builtin_prefetch(row);
  __builtin_prefetch(row + a.stride - 1);
}

// The part of the image a tile covers.
struct TileArea {
  int x, y, width, height;
};

template <typename T>
inline TileArea tile_area(const RasterArgs<T>& a, int tile) {
  const int x = tile % a.tiles_x * kTile, y = tile / a.tiles_x * kTile;
  return {x, y, std::min(kTile, a.width - x), std::min(kTile, a.height - y)};
}

// Place of an instance among its splat's instances, which lie row by row over the tiles it touches;
// -1 when the tile is not one of them (the adjoint is handed its lists back and trusts nothing).
template <typename T>
inline int64_t instance_slot(const RasterArgs<T>& a, const int64_t* first_slot, int32_t rank,
                             const TileArea& area) {
  const PixelBox box = splat_tiles(a.splats + int64_t(rank) * a.stride, a.width, a.height);
  const int x = area.x / kTile, y = area.y / kTile;
  if (x < box.x0 || x >= box.x1 || y < box.y0 || y >= box.y1) return -1;
  return first_slot[rank] + (y - box.y0) * (box.x1 - box.x0) + x - box.x0;
}

// Blends one tile and writes its pixels. kF: blended features when known at compile time, else 0.
// `slots` (one weight sum per instance) and `first_slot` are null unless contributions are wanted.
template <typename T, int kF, bool kGroups>
void blend_tile(const RasterArgs<T>& a, int tile, const int64_t* first_slot, T* slots) {
  const int features = kF ? kF : a.features;
  const TileArea area = tile_area(a, tile);
  BlockWalk<T, kGroups> walk;
  walk.reset(area.width, area.height);
  alignas(32) Pack<T> sum[kF ? kF : kMaxFeatures][kBlocks<T>];
  // Alpha is the sum of weights: 1 - transmittance would cost thin pixels their precision.
  alignas(32) Pack<T> weights[kBlocks<T>];
  for (auto& block : weights) block = Pack<T>{};
  for (int f = 0; f < features; ++f)
    for (auto& block : sum[f]) block = Pack<T>{};
  const T tile_x = T(area.x), tile_y = T(area.y);
  const int32_t end = a.tile_start[tile + 1];
  int32_t e = a.tile_start[tile];
  for (; e < end && walk.alive; ++e) {
    prefetch_instance(a, first_slot, e, end);
    const int32_t rank = a.instances[e];
    const T* splat = a.splats + int64_t(rank) * a.stride;
    int group = -1;
    if constexpr (kGroups) group = a.groups[a.order[rank]];
    Pack<T> total{};
    for (uint64_t bits = reached_blocks(splat, tile_x, tile_y) & walk.alive; bits;
         bits &= bits - 1) {
      const int block = __builtin_ctzll(bits);
      const auto w = walk.weigh(splat, group, block, tile_x, tile_y);
      for (int f = 0; f < features; ++f) sum[f][block] += w.weight * splat[kFeatures + f];
      weights[block] += w.weight;
      total += w.weight;
    }
    if (slots) slots[instance_slot(a, first_slot, rank, area)] = pack_sum<T>(total);
  }
  if (slots)
    for (; e < end; ++e) slots[instance_slot(a, first_slot, a.instances[e], area)] = T(0);

  for (int y = 0; y < area.height; ++y) {
    for (int x = 0; x < area.width; ++x) {
      const int block = x / kLanes<T> * kTile + y, lane = x % kLanes<T>;
      const int64_t pixel = int64_t(area.y + y) * a.width + area.x + x;
      const T left = std::abs(walk.transmittance[block][lane]);
      const T alpha = std::min(weights[block][lane], T(1));
      a.alpha[pixel] = alpha;
      for (int c = 0; c < a.channels; ++c)
        a.image[pixel * a.channels + c] =
            sum[c][block][lane] + (a.background ? left * a.background[c] : T(0));
      if (a.has_normals)
        for (int c = 0; c < 3; ++c) a.normal[3 * pixel + c] = sum[a.channels + c][block][lane];
      a.depth[pixel] = alpha > T(0) ? sum[features - 1][block][lane] / alpha : T(0);
    }
  }
}

// Adjoint of blend_tile. Per instance it writes one row of `slots`: the moments of the opacity
// gradient (sum v dx, v dy, v dx^2, v dx dy, v dy^2, v with v = dL/d ln alpha), then the gradients
// of the first `active` features. `background` is this tile's share, [C], or null.
template <typename T, int kF, bool kGroups>
void blend_tile_backward(const RasterGradArgs<T>& b, int tile, int active_features,
                         const int64_t* first_slot, T* slots, T* background) {
  const RasterArgs<T>& a = b.forward;
  const int active = kF ? kF : active_features;
  const int width = kGradFeatures + active;
  const TileArea area = tile_area(a, tile);
  BlockWalk<T, kGroups> walk;
  walk.reset(area.width, area.height);
  alignas(32) Pack<T> grad[kF ? kF : kMaxFeatures][kBlocks<T>];
  // What everything from the current splat to the back adds to the loss:
  // g.(blended features + T bg) - g_alpha T, reduced splat by splat.
  alignas(32) Pack<T> behind[kBlocks<T>];
  for (int f = 0; f < active; ++f)
    for (auto& block : grad[f]) block = Pack<T>{};
  for (auto& block : behind) block = Pack<T>{};
  for (int y = 0; y < area.height; ++y) {
    for (int x = 0; x < area.width; ++x) {
      const int block = x / kLanes<T> * kTile + y, lane = x % kLanes<T>;
      const int64_t pixel = int64_t(area.y + y) * a.width + area.x + x;
      const T alpha = a.alpha[pixel], left = T(1) - alpha;
      T total = T(0);
      for (int c = 0; c < a.channels && b.grad_image; ++c) {
        const T g = b.grad_image[pixel * a.channels + c];
        grad[c][block][lane] = g;
        total += g * a.image[pixel * a.channels + c];
        if (background) background[c] += g * left;
      }
      for (int c = 0; c < 3 && b.grad_normal; ++c) {
        const T g = b.grad_normal[3 * pixel + c];
        grad[a.channels + c][block][lane] = g;
        total += g * a.normal[3 * pixel + c];
      }
      T grad_alpha = b.grad_alpha ? b.grad_alpha[pixel] : T(0);
      if (b.grad_depth && alpha > T(0)) {
        const T g = b.grad_depth[pixel];
        grad[active - 1][block][lane] = g / alpha;
        grad_alpha -= g * a.depth[pixel] / alpha;
        total += g * a.depth[pixel];
      }
      behind[block][lane] = total - grad_alpha * left;
    }
  }

  const T tile_x = T(area.x), tile_y = T(area.y);
  const int32_t end = a.tile_start[tile + 1];
  int32_t e = a.tile_start[tile];
  for (; e < end && walk.alive; ++e) {
    prefetch_instance(a, first_slot, e, end);
    const int32_t rank = a.instances[e];
    const T* splat = a.splats + int64_t(rank) * a.stride;
    int group = -1;
    if constexpr (kGroups) group = a.groups[a.order[rank]];
    Pack<T> moment[kGradFeatures] = {};
    Pack<T> feature[kF ? kF : kMaxFeatures];
    for (int f = 0; f < active; ++f) feature[f] = Pack<T>{};
    for (uint64_t bits = reached_blocks(splat, tile_x, tile_y) & walk.alive; bits;
         bits &= bits - 1) {
      const int block = __builtin_ctzll(bits);
      const auto w = walk.weigh(splat, group, block, tile_x, tile_y);
      Pack<T> along{};
      for (int f = 0; f < active; ++f) {
        along += grad[f][block] * splat[kFeatures + f];
        feature[f] += w.weight * grad[f][block];
      }
      const Pack<T> rest = behind[block] - w.weight * along;
      behind[block] = rest;
      const Pack<T> v = w.open ? w.weight * along - w.alpha * rest / (T(1) - w.alpha) : Pack<T>{};
      const Pack<T> vx = v * w.dx;
      moment[0] += vx;
      moment[1] += v * w.dy;
      moment[2] += vx * w.dx;
      moment[3] += vx * w.dy;
      moment[4] += v * (w.dy * w.dy);
      moment[5] += v;
    }
    const int64_t place = instance_slot(a, first_slot, rank, area);
    if (place < 0) continue;
    T* slot = slots + place * width;
    for (int k = 0; k < kGradFeatures; ++k) slot[k] = pack_sum<T>(moment[k]);
    for (int f = 0; f < active; ++f) slot[kGradFeatures + f] = pack_sum<T>(feature[f]);
  }
  for (; e < end; ++e) {
    const int64_t place = instance_slot(a, first_slot, a.instances[e], area);
    if (place >= 0) std::fill_n(slots + place * width, width, T(0));
  }
}

}  // namespace gsf::raster_cpu
