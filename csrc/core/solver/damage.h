// The damage field of phase-field matter in a step of the resident solver: what points give to the
// nodes, the equation of a node and its relaxation, and what points get. Both back ends' loops do
// this; gsfluent/ops/damage.py says what, docs/theory/phase-field.md why. Everything between the
// points is in double.
#pragma once

#include "core/solver/particle.h"

namespace gsf {

inline constexpr double kOmega = 1.5;
inline constexpr int kSweeps = 4;
// Volume below which a node is empty, over that of the largest point: what it holds beyond that is
// rounding, and whether an edge leads there must not hang on it.
inline constexpr double kEmptyNode = 1.0 / double(1 << 24);

// Sums of a node: damage, history and stiffness times volume, and volume; volumes in units of dx^2
// / 4, as rows have them.
inline constexpr int kDamageSum = 0, kDriveSum = 1, kStiffSum = 2, kVolumeSum = 3, kDamageSums = 4;

// Planes of SolverView::damage_slots: the step in which a slot has points to solve for, that in
// which it takes part, the lists of both, and the slots beyond the faces or what stands there.
enum DamagePlane : int { kHotPlane, kActivePlane, kHotList, kActiveList, kFaces };
inline constexpr int kDamagePlanes = kFaces + 6;
enum DamageCount : int { kHotCount, kActiveCount, kHomeCount, kNextHome };
// Of SolverView::damage_scale, after the units of the sums.
inline constexpr int kScaleAt2 = kDamageSums, kScaleEmpty = kDamageSums + 1,
                     kScaleStiff = kDamageSums + 2, kDamageScales = kDamageSums + 3;
enum DamageFace : int32_t { kNoBlock = -1, kUndamaged = -2 };

// What a point gives before its weights, of numbers or of packs of them: its volume, in the unit of
// rows; the length in cells.
template <typename T>
GSF_HOST_DEVICE void damage_given(T volume, T length, T alpha, T peak, T* out) {
  out[kDamageSum] = volume * damage_of(peak);
  out[kDriveSum] = volume * min(alpha + T(1), T(kDriveMax));
  out[kStiffSum] = volume * (T(2) * length * length);
  out[kVolumeSum] = volume;
}

// One node of the field: its value, stiffness, and its equation, value = inverse (right + sum of
// weight times value over the neighbours). inverse 0: no matter is there.
struct DamageNode {
  double value, stiff, right, inverse;
};
// Weight of the edge between two nodes with matter.
GSF_HOST_DEVICE double edge_weight(double stiff, double beyond) { return 0.5 * (stiff + beyond); }
// weight(f): of the edge towards neighbour f of x+, x-, y+, y-, z+, z-; the own stiffness where
// nothing is damaged beyond, and 0 towards an empty node. `empty` is the largest volume of those.
template <typename Weight>
GSF_HOST_DEVICE DamageNode damage_node(const double* sums, bool at2, double empty,
                                       const Weight& weight) {
  const double volume = sums[kVolumeSum], drive = sums[kDriveSum];
  if (!(volume > empty)) return {0.0, 0.0, 0.0, 0.0};
  double whole = at2 ? drive + 2.0 * volume : drive;
  for (int f = 0; f < 6; ++f) whole += weight(f);
  return {sums[kDamageSum] / volume, sums[kStiffSum], at2 ? drive : drive - volume,
          whole > 0.0 ? 1.0 / whole : 0.0};
}
// Place of neighbour f of node `local` of a block; `inside` says whether it is in the same one.
GSF_HOST_DEVICE int face_node(int local, int f, bool& inside) {
  const int shift = 4 - f / 2 * 2;  // of the axis in the local index
  const int at = local >> shift & 3, to = f % 2 == 0 ? at + 1 : at - 1;
  inside = to >= 0 && to < 4;
  return (local & ~(3 << shift)) | (to & 3) << shift;
}
// The block beyond face f, of the 27 around.
GSF_HOST_DEVICE int face_block(int f) {
  const int step = f / 2 == 0 ? 9 : (f / 2 == 1 ? 3 : 1);
  return f % 2 == 0 ? 13 + step : 13 - step;
}
// Colour of a node: blocks are four wide, so that it is that of its place in the block.
GSF_HOST_DEVICE int node_colour(int local) { return ((local >> 4) + (local >> 2) + local) & 1; }
// Over-relaxed value; `sum` is the right side with the neighbours.
GSF_HOST_DEVICE double relaxed(double value, double sum, double inverse) {
  const double next = value + kOmega * (sum * inverse - value);
  return next < 0.0 ? 0.0 : (next > 1.0 ? 1.0 : next);
}

// Peak of a point that found this much of the field.
template <typename T>
GSF_HOST_DEVICE T peak_after(T peak, T found) {
  const T d = max(damage_of(peak), min(found, T(1)));
  return d > T(0) ? max(peak, d - T(kBrokenDamage)) : peak;
}

}  // namespace gsf
