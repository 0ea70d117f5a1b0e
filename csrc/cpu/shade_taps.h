// The looks of soft shadows (core/shade/shadow.h: ShadowTaps, ShadowView), eight or, in double,
// four of a disc at once. tests/ops/test_shade.py holds them to the model.
#pragma once

#include <algorithm>
#include <vector>

#include "core/shade/shadow.h"
#include "cpu/pack.h"
#include "torch_api.h"

namespace gsf::cpu {

// Points of the spiral over the unit disc.
template <typename T, int kTaps>
struct Disc {
  alignas(32) T x[kTaps], y[kTaps];

  Disc() {
    Spiral<T> spiral;
    for (int i = 0; i < kTaps; ++i) spiral.point(i, kTaps, x + i, y + i);
  }
  static const Disc& get() {
    static const Disc disc;
    return disc;
  }
};

// Opacity and depth of shadow maps beside each other, the edge repeated once around.
template <typename T>
class PaddedMaps {
 public:
  static int64_t size_of(int texels) { return 2 * int64_t(texels + 2) * (texels + 2); }

  explicit PaddedMaps(const ShadeArgs<T>& a) : values_(a.maps * size_of(a.texels) + 2) {
    const int64_t side = a.texels + 2;
    parallel_for(a.maps * side, 64, [&](int64_t begin, int64_t end) {
      for (int64_t at = begin; at < end; ++at) {
        const int64_t map = at / side, line = inner(at % side, a.texels);
        const int64_t from = (map * a.texels + line) * a.texels;
        T* to = values_.data() + 2 * at * side;
        for (int64_t x = 0; x < side; ++x) {
          to[2 * x] = a.map_alpha[from + inner(x, a.texels)];
          to[2 * x + 1] = a.map_depth[from + inner(x, a.texels)];
        }
      }
    });
  }
  const T* data() const { return values_.data(); }

 private:
  static int64_t inner(int64_t x, int64_t texels) {
    return std::clamp<int64_t>(x - 1, 0, texels - 1);
  }
  std::vector<T> values_;  // and room for the texel after the last
};

template <typename T>
struct PackTaps {
  using P = Pack<T>;
  using Int = typename P::Int;
  static constexpr int kLanes = P::kLanes;

  const ShadowView<T>& view;
  const T* map;  // this lamp's, of PaddedMaps

  PackTaps(const ShadeArgs<T>& a, int face, const ShadowView<T>& v)
      : view(v), map(a.pairs + int64_t(face) * PaddedMaps<T>::size_of(a.texels)) {}

  // ShadowView::own_depth and before.
  P own_depth(P du, P dv) const {
    if (!(view.level < T(0))) return P(view.depth);
    const P tu = P(view.u) + du / P(view.focal), tv = P(view.v) + dv / P(view.focal);
    const P below = P(view.plane.x) * tu + P(view.plane.y) * tv + P(view.plane.z);
    const P room = P(T(kSteepest) / view.per_depth) * sqrt(du * du + dv * dv);
    const P along = select<T>(below < P(-kTinyLength), P(view.level) / below, P(view.depth));
    return clamp(along, P(view.depth) - room, P(view.depth) + room);
  }
  P before(P own, P found) const {
    const P share = (own - P(view.bias) - found) * P(view.hardness);
    return select<T>(share > P(0), min(share, P(1)), P(0));
  }

  // From a texel's number, which may be past the edge or NaN, to its place along a padded axis.
  Int within(P x) const {
    const P inside = min(max(x, P(-1)), P(view.size - 1)) + P(1);
    return __builtin_convertvector(inside.v, Int);
  }
  // Opacity and depth of a texel, then of the next in its line.
  void look(Int line, Int column, P* four) const {
    Quad<T> texels[kLanes];
    for (int lane = 0; lane < kLanes; ++lane)
      texels[lane] = load_quad(map + 2 * (int64_t(line[lane]) * (view.size + 2) + column[lane]));
    transpose(texels, four);
  }

  void search(T reach, T& weight, T& total, T& deepest) const {
    const auto& disc = Disc<T, kSearchTaps>::get();
    for (int i = 0; i < kSearchTaps; i += kLanes) {
      const P du = P(reach) * load_pack(disc.x + i), dv = P(reach) * load_pack(disc.y + i);
      // towards zero, as index_within: what lies before the first texel is in the first
      const Int line = within(max(P(view.y) + dv, P(0))),
                column = within(max(P(view.x) + du, P(0)));
      P texel[4];
      look(line, column, texel);
      const P opacity = texel[0], found = texel[1];
      const Int seen = opacity > P(0);
      if (mask_bits(seen) == 0) continue;
      const P share = select<T>(seen, opacity * before(own_depth(du, dv), found), P(0));
      for (uint32_t left = mask_bits(share > P(0)); left != 0; left &= left - 1) {
        const int lane = __builtin_ctz(left);
        weight += share[lane];
        total += share[lane] * found[lane];
        if (share[lane] > T(kSure)) deepest = gsf::max(deepest, found[lane]);
      }
    }
  }

  T filter(T spread) const {
    const auto& disc = Disc<T, kFilterTaps>::get();
    P blocked(0);
    for (int i = 0; i < kFilterTaps; i += kLanes) {
      const P du = P(spread) * load_pack(disc.x + i), dv = P(spread) * load_pack(disc.y + i);
      // past the edge of the map all corners are those of the edge
      const auto place = [&](P x) { return min(max(x, P(-1)), P(view.size - 1)); };
      const P x = place(P(view.x) + du - P(0.5)), y = place(P(view.y) + dv - P(0.5));
      Int whole;
      const P left = floor(x, whole), top = floor(y, whole), fx = x - left, fy = y - top;
      const Int column = within(left);
      for (int below = 0; below < 2; ++below) {
        P texel[4];
        look(within(top) + below, column, texel);
        const Int near = texel[0] > P(0), next = texel[2] > P(0);
        if (mask_bits(near | next) == 0) continue;
        const P own = own_depth(du, dv);
        const P down = below != 0 ? fy : P(1) - fy;
        blocked += select<T>(near, down * (P(1) - fx) * texel[0] * before(own, texel[1]), P(0));
        blocked += select<T>(next, down * fx * texel[2] * before(own, texel[3]), P(0));
      }
    }
    T sum(0);
    for (int lane = 0; lane < kLanes; ++lane) sum += blocked[lane];
    return sum;
  }
};

}  // namespace gsf::cpu
