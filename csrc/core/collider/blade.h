// A blade: a straight edge that moves along a polyline and parts what it passes. Each leg of the
// polyline is a row; the part of its sheet that the edge passed since the last look is a rectangle.
// Matter within reach of that rectangle gets a side once, and keeps it: two bits per blade in an
// integer `cut`, 01 above the sheet, 10 below. Fields of one body that lie on opposite sides of a
// blade are in contact, all other fields of a body move as one (core/mpm/contact.h, merge_group).
#pragma once

#include "core/collider/shape.h"

namespace gsf {

enum BladeColumn {
  kBladeStart = 0,       // middle of the edge at the start of the leg [m]
  kBladeEdge = 3,        // unit vector along the edge
  kBladeWay = 6,         // unit vector along the leg
  kBladeLength = 9,      // of the leg [m]
  kBladeHalfWidth = 10,  // half the length of the edge [m]
  kBladeFrom = 11,       // place of the edge on the leg at the last look [m]
  kBladeTo = 12,         // place of the edge now [m]; not beyond `from` when it has not moved
  kBladeNumber = 13,     // 0 to 14: which two bits of `cut`
  kBladeJoints = 14      // 1: the sheet goes on before the start, 2: beyond the end of the leg
};
constexpr int kBladeColumns = 16;
constexpr int kMaxBlades = 15;

// Whether sides a and b lie on opposite sides of some blade.
GSF_HOST_DEVICE bool cut_apart(int32_t a, int32_t b) {
  const uint32_t p = static_cast<uint32_t>(a), q = static_cast<uint32_t>(b);
  return ((((p << 1) & q) | ((q << 1) & p)) & 0x2aaaaaaau) != 0;
}

// Coordinates in the sheet of a leg: x = start + along way + across edge + height normal.
template <typename T>
struct BladePlace {
  T along, across, height;
};

template <typename T>
GSF_HOST_DEVICE bool blade_valid(const T* row) {
  for (int i = 0; i < kBladeColumns; ++i)
    if (!finite(row[i])) return false;
  const Vec3<T> edge = load_vec3(row + kBladeEdge), way = load_vec3(row + kBladeWay);
  return norm(cross(edge, way)) > T(1e-3) && row[kBladeLength] > T(0) &&
         row[kBladeHalfWidth] > T(0) && row[kBladeNumber] >= T(0) &&
         row[kBladeNumber] < T(kMaxBlades);
}

template <typename T>
GSF_HOST_DEVICE BladePlace<T> blade_place(const T* row, const Vec3<T>& x) {
  const Vec3<T> edge = load_vec3(row + kBladeEdge), way = load_vec3(row + kBladeWay);
  const Vec3<T> d = x - load_vec3(row + kBladeStart);
  const Vec3<T> n = cross(edge, way);
  const Vec3<T> across_edge = way - dot(way, edge) * edge;
  BladePlace<T> p;
  p.height = dot(d, n) / norm(n);
  p.along = dot(d, across_edge) / dot(across_edge, across_edge);
  p.across = dot(d, edge) - p.along * dot(way, edge);
  return p;
}

// Side of the (endless) sheet of a leg: 1 where edge x way points, else 2.
template <typename T>
GSF_HOST_DEVICE int blade_side(const T* row, const Vec3<T>& x) {
  return blade_place(row, x).height >= T(0) ? 1 : 2;
}

// Distance of x from the part of the sheet that the edge passed since the last look, if x lies over
// or under it, or over or under the joint to a neighbouring leg; negative otherwise.
template <typename T>
GSF_HOST_DEVICE T blade_swept(const T* row, const Vec3<T>& x) {
  const T from = row[kBladeFrom], to = row[kBladeTo];
  if (!(to > from)) return T(-1);
  const BladePlace<T> p = blade_place(row, x);
  if (!(p.across <= row[kBladeHalfWidth] && -p.across <= row[kBladeHalfWidth])) return T(-1);
  const int joints = static_cast<int>(row[kBladeJoints]);
  T beyond = T(0);
  if (p.along < from) {
    if ((joints & 1) == 0 || from > T(0)) return T(-1);
    beyond = from - p.along;
  } else if (p.along > to) {
    if ((joints & 2) == 0 || to < row[kBladeLength]) return T(-1);
    beyond = p.along - to;
  }
  return norm(Vec3<T>{beyond, p.height, T(0)});
}

// `cut` of a particle at x after a look at all legs: the nearest swept rectangle of each blade
// decides its side, if it is within `reach` and has none yet.
template <typename T>
GSF_HOST_DEVICE int32_t blade_cut(const T* rows, int64_t count, const Vec3<T>& x, T reach,
                                  int32_t cut) {
  for (int64_t first = 0; first < count;) {
    const T number = rows[first * kBladeColumns + kBladeNumber];
    T nearest = reach;
    int side = 0;
    int64_t i = first;
    for (; i < count && rows[i * kBladeColumns + kBladeNumber] == number; ++i) {
      const T* row = rows + i * kBladeColumns;
      if (!blade_valid(row)) continue;
      const T distance = blade_swept(row, x);
      if (!(distance >= T(0) && distance <= nearest)) continue;
      nearest = distance;
      side = blade_side(row, x);
    }
    // A number that is NaN equals nothing, itself included.
    first = i > first ? i : first + 1;
    if (side == 0) continue;
    const int shift = 2 * static_cast<int>(number);
    if ((cut >> shift & 3) == 0) cut |= side << shift;
  }
  return cut;
}

}  // namespace gsf
