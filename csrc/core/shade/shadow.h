// Percentage-closer soft shadows of one point (Fernando 2005): blockers on a disc of the map give a
// mean depth, that and the lamp's size the penumbra, and blocking is averaged over it. Constants
// and rules are those of gsfluent/pipeline/light/shadow.py, the model; a test holds the two
// together.
#pragma once

#include "core/shade/args.h"

namespace gsf {

constexpr int kSearchTaps = 16;
constexpr int kFilterTaps = 32;
constexpr double kLeastSearch = 2.0;  // texels
constexpr double kNarrower = 4.0;  // times: what the looks at a wide disc miss, a narrow one meets
constexpr int kNarrowings = 4;
constexpr double kLeastFilter = 1.2;
constexpr double kMostSpread = 0.25;  // of the map's side
constexpr double kSure = 0.3;         // opacity from which a blocker counts for the deepest one
constexpr double kSteepest = 4.0;
constexpr double kNormalOffset = 1.0;  // biases that a point is lifted off bumpy splats
constexpr double kFade = 4.0;  // biases past the bias from which on a blocker counts in full
constexpr double kTinyLength = 1e-12;
constexpr int kBlockerEdge = 4;  // texels along a block of ShadeArgs::blockers

// Points of Vogel's spiral over the unit disc, one after the other: turns by the golden angle.
template <typename T>
struct Spiral {
  T c = T(1), s = T(0);
  GSF_HOST_DEVICE void point(int i, int taps, T* x, T* y) {
    using std::sqrt;
    const T r = sqrt((T(i) + T(0.5)) / T(taps));
    *x = r * c;
    *y = r * s;
    const T gc = T(-0.73736887807831963), gs = T(0.67549029426152359);  // pi (3 - sqrt 5)
    const T turned = c * gc - s * gs;
    s = c * gs + s * gc;
    c = turned;
  }
};

// The integer below x within [lo, hi]; lo for NaN. Never converts what an int cannot hold.
template <typename T>
GSF_HOST_DEVICE int index_within(T x, int lo, int hi) {
  return x >= T(lo) ? (x < T(hi) ? static_cast<int>(x) : hi) : lo;
}

// One map as a point sees it.
template <typename T>
struct ShadowView {
  const T *depth_map, *alpha_map;
  int size;
  Vec3<T> plane;  // the surface's normal in the map's camera
  T u, v, x, y;   // slopes and texel of the point
  T depth, focal, nearest, bias, hardness, level, per_depth;

  GSF_HOST_DEVICE T own_depth(T du, T dv) const {
    using std::sqrt;
    if (!(level < T(0))) return depth;
    const T tu = u + du / focal, tv = v + dv / focal;
    const T below = plane.x * tu + plane.y * tv + plane.z;
    const T room = T(kSteepest) * sqrt(du * du + dv * dv) / per_depth;
    const T along = below < T(-kTinyLength) ? level / below : depth;
    return clamp(along, depth - room, depth + room);
  }
  // How far something at depth `found` counts as before the surface, which is `own` deep there.
  // Translucent layers of a skin lie at other depths for the lamp than for the camera: a step at
  // the bias would draw its own edge.
  GSF_HOST_DEVICE T before(T own, T found) const {
    const T share = (own - bias - found) * hardness;
    return share > T(0) ? min(share, T(1)) : T(0);  // 0 for NaN
  }
  GSF_HOST_DEVICE int64_t texel(T column, T line) const {
    return int64_t(index_within(line, 0, size - 1)) * size + index_within(column, 0, size - 1);
  }
};

GSF_HOST_DEVICE int blocker_blocks(int texels) {
  return (texels + kBlockerEdge - 1) / kBlockerEdge;
}

// False when the map has nothing opaque within `reach` texels of a texel: one look instead of many.
template <typename T>
GSF_HOST_DEVICE bool may_block(const int32_t* blockers, int texels, T x, T y, T reach) {
  const int last = texels - 1, pitch = blocker_blocks(texels) + 1;
  const int left = index_within(x - reach, 0, last) / kBlockerEdge,
            right = index_within(x + reach, 0, last) / kBlockerEdge + 1,
            top = index_within(y - reach, 0, last) / kBlockerEdge * pitch,
            bottom = (index_within(y + reach, 0, last) / kBlockerEdge + 1) * pitch;
  return blockers[bottom + right] - blockers[bottom + left] - blockers[top + right] +
             blockers[top + left] !=
         0;
}

// The looks at a map, one after the other. cpu/shade_taps.h takes several at once.
template <typename T>
struct ShadowTaps {
  const ShadowView<T>& view;

  GSF_HOST_DEVICE ShadowTaps(const ShadeArgs<T>&, int, const ShadowView<T>& v) : view(v) {}

  // Weight, weighted depth and depth of the deepest sure one of the blockers within `reach` texels.
  GSF_HOST_DEVICE void search(T reach, T& weight, T& total, T& deepest) const {
    Spiral<T> spiral;
    for (int i = 0; i < kSearchTaps; ++i) {
      T du, dv;
      spiral.point(i, kSearchTaps, &du, &dv);
      du *= reach;
      dv *= reach;
      const int64_t index = view.texel(view.x + du, view.y + dv);
      const T found = view.depth_map[index], opacity = view.alpha_map[index];
      if (!(opacity > T(0))) continue;
      const T share = opacity * view.before(view.own_depth(du, dv), found);
      if (share > T(0)) {
        weight += share;
        total += share * found;
        if (share > T(kSure)) deepest = max(deepest, found);
      }
    }
  }
  // Blocking over a disc of `spread` texels, summed over its taps.
  GSF_HOST_DEVICE T filter(T spread) const {
    using std::floor;
    T blocked = T(0);
    Spiral<T> spiral;
    for (int i = 0; i < kFilterTaps; ++i) {
      T du, dv;
      spiral.point(i, kFilterTaps, &du, &dv);
      du *= spread;
      dv *= spread;
      const T own = view.own_depth(du, dv);
      const T column = view.x + du - T(0.5), line = view.y + dv - T(0.5);
      const T left = floor(column), top = floor(line), fx = column - left, fy = line - top;
      for (int corner = 0; corner < 4; ++corner) {
        const int dx = corner & 1, dy = corner >> 1;
        const int64_t index = view.texel(left + T(dx), top + T(dy));
        const T share = view.alpha_map[index];
        if (share > T(0))
          blocked += (dx ? fx : T(1) - fx) * (dy ? fy : T(1) - fy) * share *
                     view.before(own, view.depth_map[index]);
      }
    }
    return blocked;
  }
};

// Which of a lamp's maps looks at a point: that in which it is deepest.
template <typename T>
GSF_HOST_DEVICE int shadow_face(const ShadeArgs<T>& a, const T* lamp, const Vec3<T>& p) {
  const int first = index_within(lamp[10], 0, a.maps - 1);
  const int count = min(index_within(lamp[11], 1, kCubeFaces), a.maps - first);
  int best = first;
  T deepest = T(0);
  for (int k = 0; k < count && count > 1; ++k) {
    const T* row = a.map_cameras + kMapColumns * (first + k);
    const T z = row[8] * p.x + row[9] * p.y + row[10] * p.z + row[11];
    if (k == 0 || z > deepest) {
      deepest = z;
      best = first + k;
    }
  }
  return best;
}

// Share of the lamp's light that reaches a point with unit normal; 1 behind the lamp.
template <typename Taps, typename T>
GSF_HOST_DEVICE T shadow_transmittance(const ShadeArgs<T>& a, const T* lamp, const Vec3<T>& point,
                                       const Vec3<T>& normal, T biased) {
  if (!a.map_depth || !(lamp[10] >= T(0))) return T(1);
  const int face = shadow_face(a, lamp, point);
  const T* row = a.map_cameras + kMapColumns * face;
  ShadowView<T> view;
  view.size = a.texels;
  view.depth_map = a.map_depth + int64_t(face) * a.texels * a.texels;
  view.alpha_map = a.map_alpha + int64_t(face) * a.texels * a.texels;
  const Vec3<T> r0{row[0], row[1], row[2]}, r1{row[4], row[5], row[6]}, r2{row[8], row[9], row[10]};
  const Vec3<T> raised = point + (T(kNormalOffset) * biased * row[14]) * normal;
  const Vec3<T> local{dot(r0, raised) + row[3], dot(r1, raised) + row[7],
                      dot(r2, raised) + row[11]};
  view.plane = {dot(r0, normal), dot(r1, normal), dot(r2, normal)};
  view.depth = local.z;
  view.focal = row[12];
  view.nearest = row[13];
  view.bias = biased * row[14];
  view.hardness = T(1) / max(T(kFade) * view.bias, T(kTinyLength));
  const T safe = max(local.z, T(kTinyLength)), half = T(0.5) * T(a.texels);
  view.u = local.x / safe;
  view.v = local.y / safe;
  view.x = view.u * view.focal + half;
  view.y = view.v * view.focal + half;
  const T side = T(a.texels);
  if (!(local.z > T(0))) return T(1);
  view.level = dot(view.plane, local);
  view.per_depth = view.focal / safe;
  const bool is_point = lamp[0] > T(0.5);
  const T most = T(kMostSpread) * side;

  // How far blockers as near to the lamp as possible could spread.
  const T closest = min(view.nearest, safe);
  T search = lamp[9] * (view.depth - closest) * view.per_depth;
  if (is_point) search = search / max(closest, T(kTinyLength));
  search = clamp(search, T(kLeastSearch), most);
  const Taps taps(a, face, view);
  T weight = T(0), total = T(0), deepest = T(0);
  for (int narrowing = 0;; ++narrowing, search = max(search / T(kNarrower), T(kLeastSearch))) {
#ifndef __CUDA_ARCH__
    if (a.blockers != nullptr) {
      const int pitch = blocker_blocks(a.texels) + 1;
      if (!may_block(a.blockers + int64_t(face) * pitch * pitch, a.texels, view.x, view.y, search))
        return T(1);
    }
#endif
    taps.search(search, weight, total, deepest);
    if (weight > T(0)) break;
    // Something high above widens the disc for all that lies below it.
    if (narrowing == kNarrowings || !(search > T(kLeastSearch))) return T(1);
  }
  // Of what a lamp sees of a body the rim, which limits the light, is deepest.
  const T mean = total / max(weight, T(kTinyLength));
  const T blocker = T(0.5) * (mean + max(mean, deepest));
  T spread = lamp[9] * max(view.depth - blocker, T(0)) * view.per_depth;
  if (is_point) spread = spread / max(blocker, T(kTinyLength));
  spread = clamp(spread, T(kLeastFilter), most);
  return T(1) - clamp(taps.filter(spread) / T(kFilterTaps), T(0), T(1));
}

}  // namespace gsf
