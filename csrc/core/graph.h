// Graphs of links between points: how far each link is stretched, what hangs together, and which
// seed is nearest along links. Their use: gsfluent/pipeline/matter/pieces.py.
//
// Lengths are rounded where torch, asked one operation at a time, rounds them, and all that is
// compared afterwards are whole numbers: both back ends give the same links, roots and keys.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/spatial.h"

namespace gsf {

// Rows of points, two for each link. What names no point is no link.
struct Links {
  int64_t count;        // L
  int64_t points;       // N
  const int64_t* link;  // [L, 2]

  GSF_HOST_DEVICE bool ends(int64_t l, int64_t* a, int64_t* b) const {
    *a = link[2 * l];
    *b = link[2 * l + 1];
    return *a >= 0 && *b >= 0 && *a < points && *b < points;
  }
};

struct LinkCostsArgs {
  Links links;
  const double* length;    // at rest [L]
  const double* spacing;   // of the points' bodies [N]
  const double* position;  // [N, 3]
  const bool* broken;      // [N]
  const bool* flowing;     // [N], its links are never cut
  const bool* may_break;   // [N]
  const bool* gone;        // [N], nothing hangs on it; null for none
  const bool* before;      // cut already [L]
  double open, torn;       // ratios of lengths from which a broken link, and any, is cut
  double steep;            // of the cost with the stretch
  double unit;             // cost of a spacing
  int shift;               // bits of a key below the cost
  bool* cut;               // [L]
  int64_t* cost;           // [L], 0 of what does not hold
  bool* torn_end;          // points at an end of a cut link [N], cleared before
};

// False where no point is marked; else both ends of the link are.
GSF_HOST_DEVICE bool link_cost(const LinkCostsArgs& a, int64_t l, int64_t* one, int64_t* two) {
  a.cut[l] = a.before[l];
  a.cost[l] = 0;
  if (!a.links.ends(l, one, two)) return false;
  const double* p = a.position + 3 * *one;
  const double* q = a.position + 3 * *two;
  const double x = p[0] - q[0], y = p[1] - q[1], z = p[2] - q[2];
  const double away = std::sqrt((product(x, x) + product(y, y)) + product(z, z));
  const double rest = a.length[l];
  const double ratio = away / (rest > 1e-30 ? rest : 1e-30);
  const bool broken = a.broken[*one] || a.broken[*two];
  const bool fixed = !(a.flowing[*one] || a.flowing[*two]);
  bool cut = a.before[l] || (ratio > (broken ? a.open : a.torn) && fixed && a.may_break[*one]);
  if (a.gone) cut = cut || a.gone[*one] || a.gone[*two];
  a.cut[l] = cut;
  if (!cut && ratio < a.torn) {
    const double stretch = std::fmin(std::fmax(ratio - 1.0, 0.0), 2.0);
    const double price = product(rest / a.spacing[*one], 1.0 + product(a.steep, stretch));
    const double whole = std::fmin(std::fmax(std::rint(product(price, a.unit)), 1.0), 1073741824.0);
    a.cost[l] = int64_t(whole) << a.shift;
  }
  return cut;
}

struct ComponentsArgs {
  Links links;
  const bool* apart;   // links that do not count [L]; null for none
  const bool* inside;  // points whose links count [N]; null for all
  int64_t* root;       // [N]

  GSF_HOST_DEVICE bool joins(int64_t l, int64_t* a, int64_t* b) const {
    if ((apart && apart[l]) || !links.ends(l, a, b)) return false;
    return !inside || (inside[*a] && inside[*b]);
  }
};

constexpr int64_t kFarKey = (int64_t(1) << 62) - 1;  // of what no seed reaches

struct NearestSeedsArgs {
  Links links;
  const int64_t* cost;  // [L], 0 or less: the link does not hold
  const bool* other;    // points that may be reached [N]
  int64_t* key;         // [N], of the seeds before, of all they reach after
  int64_t* leading;     // [L + 2], links that lead anywhere; then their number, and a flag

  GSF_HOST_DEVICE bool leads(int64_t l, int64_t* a, int64_t* b) const {
    return cost[l] > 0 && links.ends(l, a, b) && (other[*a] || other[*b]);
  }
  // What a link offers to one of its ends; no less than what that has if there is no gain.
  GSF_HOST_DEVICE int64_t offer(int64_t l, int64_t from, int64_t to, int64_t held) const {
    const bool gives = other[to] && from < kFarKey && cost[l] < kFarKey - from;
    return gives ? from + cost[l] : held;
  }
};

}  // namespace gsf
