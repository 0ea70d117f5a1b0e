// What of the links between neighbouring points has parted, and which of them show a gap.
#pragma once

#include "core/deform/args.h"
#include "core/vec.h"

namespace gsf {

// One link: row i of the points, column k of its neighbours. A neighbour that is no row counts as
// the point itself.
template <typename T>
GSF_HOST_DEVICE void link_states(const LinkStatesArgs<T>& a, int64_t link) {
  using std::sqrt;
  const int64_t i = link / a.near_count, j = a.near[link];
  const bool own = j == i || j < 0 || j >= a.points;
  const int64_t other = own ? i : j;
  T sum = T(0);
  for (int axis = 0; axis < 3; ++axis) {
    const T d = a.position[3 * other + axis] - a.position[3 * i + axis];
    sum += d * d;
  }
  const T ratio = own ? T(1) : sqrt(sum) / max(a.apart[link], T(1e-12));
  const int mine = a.piece[i], theirs = a.piece[other];
  const bool firm =
      mine == theirs && mine >= 0 && !(a.broken != nullptr && (a.broken[i] || a.broken[other]));
  T limit = firm ? a.together : a.loose, opening = a.open;
  if (a.parted_before != nullptr) {
    if (a.parted_before[link]) limit = a.back * limit;
    if (a.opened_before[link]) opening = a.back * opening;
  }
  const bool parted = ratio > limit || (mine != theirs && mine >= 0 && theirs >= 0);
  const bool none = a.none[link];
  a.parted[link] = parted || none;
  a.opened[link] = parted && ratio > opening && !none;
  a.ratio[link] = ratio;
}

}  // namespace gsf
