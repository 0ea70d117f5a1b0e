// A dense window of nodes around one grid block, so that the inner loops of the CPU transfers see
// plain strides. Not a container of the solver: it lives for one block and one field, in the
// first-level cache.
#pragma once

#include <algorithm>
#include <vector>

#include "core/mpm/args.h"

namespace gsf::cpu {

// Blocks of equal colour are `color_stride` apart, so their tiles share no node and may be written
// at once.
inline int32_t color_stride(int32_t margin) { return (5 + 2 * margin) / kBlockEdge + 1; }

// Nodes [4 b - margin, 4 b + 5 + margin] of block b: every stencil of a particle that left its cell
// by at most `margin`.
class Window {
 public:
  Window(const BlockView& view, int64_t block) : view_(view), edge_(6 + 2 * view.margin) {
    // Nothing read through the view is trusted. Two blocks beyond the table there is no more to be
    // found than 2^31 blocks beyond it, and node coordinates fit.
    int32_t c[3];
    for (int axis = 0; axis < 3; ++axis) {
      c[axis] = std::clamp(view.coords[3 * block + axis], view.origin[axis] - 2,
                           view.origin[axis] + view.size[axis] + 1);
      first_[axis] = c[axis] * kBlockEdge - view.margin;
    }
    // A block its own coordinates do not lead back to would break the colouring; its particles go
    // the slow way.
    sound_ = view.at(c[0], c[1], c[2]) == block;
    whole_ = sound_;
    for (int32_t i = 0; i < 3; ++i)
      for (int32_t j = 0; j < 3; ++j)
        for (int32_t k = 0; k < 3; ++k) {
          neighbour_[i][j][k] = view.at(c[0] + i - 1, c[1] + j - 1, c[2] + k - 1);
          whole_ = whole_ && neighbour_[i][j][k] >= 0;
        }
  }

  bool sound() const { return sound_; }
  int32_t edge() const { return edge_; }
  int32_t nodes() const { return edge_ * edge_ * edge_; }

  // Tile offset of the stencil's base node, or -1 when the stencil is not in the window or not
  // covered by active blocks.
  template <typename T>
  int32_t offset(const Stencil<T>& s) const {
    int32_t o[3];
    for (int axis = 0; axis < 3; ++axis) {
      o[axis] = s.base[axis] - first_[axis];
      if (o[axis] < 0 || o[axis] + 2 >= edge_) return -1;
    }
    if (!whole_) {
      const int32_t ax = slot(o[0]), bx = slot(o[0] + 2), ay = slot(o[1]), by = slot(o[1] + 2),
                    az = slot(o[2]), bz = slot(o[2] + 2);
      // The sign bit of the "or" is set as soon as one of the eight blocks is missing.
      const int32_t any = neighbour_[ax][ay][az] | neighbour_[ax][ay][bz] | neighbour_[ax][by][az] |
                          neighbour_[ax][by][bz] | neighbour_[bx][ay][az] | neighbour_[bx][ay][bz] |
                          neighbour_[bx][by][az] | neighbour_[bx][by][bz];
      if (any < 0) return -1;
    }
    return (o[0] * edge_ + o[1]) * edge_ + o[2];
  }

  // Calls f(tile index, flat node index, run) for every run of nodes along z that lies in one
  // active block.
  template <typename F>
  void for_each_run(const F& f) const {
    for (int32_t i = 0; i < edge_; ++i)
      for (int32_t j = 0; j < edge_; ++j)
        for (int32_t k = 0; k < edge_;) {
          const int32_t local = local_of(first_[2] + k);
          const int32_t run = std::min(kBlockEdge - local, edge_ - k);
          const int32_t b = neighbour_[slot(i)][slot(j)][slot(k)];
          if (b >= 0) {
            const int32_t l = local_index(local_of(first_[0] + i), local_of(first_[1] + j), local);
            f((i * edge_ + j) * edge_ + k, int64_t(b) * kBlockNodes + l, run);
          }
          k += run;
        }
  }

 private:
  // Which of the three neighbours along one axis holds tile coordinate o: the centre block starts
  // at o = margin.
  int32_t slot(int32_t o) const { return (o - view_.margin + kBlockEdge) >> 2; }

  const BlockView& view_;
  int32_t edge_;
  int32_t first_[3];
  int32_t neighbour_[3][3][3];
  bool sound_, whole_;
};

// Clamped range of `order` that belongs to a block, whatever `start` holds.
struct OrderRange {
  int64_t begin, end;
  OrderRange(const BlockView& view, int64_t block)
      : begin(std::clamp<int64_t>(view.start[block], 0, view.particles)),
        end(std::clamp<int64_t>(view.start[block + 1], begin, view.particles)) {}
};

// Bit mask of the fields that have particles in a block (kMaxFields = 64 bits).
inline uint64_t fields_in(const BlockView& view, const OrderRange& range, const int32_t* body,
                          int32_t fields) {
  if (body == nullptr) return range.end > range.begin ? 1 : 0;
  uint64_t mask = 0;
  for (int64_t s = range.begin; s < range.end; ++s) {
    const int32_t p = view.order[s];
    if (p < 0 || p >= view.particles) continue;
    const int32_t f = body[p];
    if (f >= 0 && f < fields) mask |= uint64_t(1) << f;
  }
  return mask;
}

}  // namespace gsf::cpu
