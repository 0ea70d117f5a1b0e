// CPU kernel of the shading op.
#include "host/shade.h"

#include <algorithm>
#include <optional>
#include <vector>

#include "core/shade/shade.h"
#include "cpu/shade_taps.h"

namespace gsf {
namespace {

// Running sums of ShadeArgs::blockers over the shadow maps: most points of a floor have nothing
// between themselves and a lamp.
template <typename T>
std::vector<int32_t> blocker_sums(const ShadeArgs<T>& a) {
  const int blocks = blocker_blocks(a.texels), pitch = blocks + 1;
  std::vector<int32_t> sums(int64_t(a.maps) * pitch * pitch, 0);
  parallel_for(a.maps, 1, [&](int64_t begin, int64_t end) {
    std::vector<uint8_t> opaque(blocks);
    for (int64_t map = begin; map < end; ++map) {
      const T* alpha = a.map_alpha + map * a.texels * a.texels;
      int32_t* sum = sums.data() + map * pitch * pitch;
      for (int line = 0; line < blocks; ++line) {
        std::fill(opaque.begin(), opaque.end(), uint8_t(0));
        const int last = std::min((line + 1) * kBlockerEdge, a.texels);
        for (int y = line * kBlockerEdge; y < last; ++y)
          for (int x = 0; x < a.texels; ++x)
            opaque[x / kBlockerEdge] |= alpha[int64_t(y) * a.texels + x] > T(0) ? 1 : 0;
        int32_t along = 0;
        for (int column = 0; column < blocks; ++column) {
          along += opaque[column];
          sum[(line + 1) * pitch + column + 1] = sum[line * pitch + column + 1] + along;
        }
      }
    }
  });
  return sums;
}

struct ShadeCpu {
  using Scope = CpuScope;
  template <typename T>
  static void shade(const ShadeArgs<T>& given, const Scope&) {
    ShadeArgs<T> a = given;
    std::vector<int32_t> blockers;
    std::optional<cpu::PaddedMaps<T>> pairs;
    if (a.map_depth != nullptr) {
      blockers = blocker_sums(a);
      pairs.emplace(a);
      a.blockers = blockers.data();
      a.pairs = pairs->data();
    }
    // Short pieces: lit and shadowed rows cost many times what the backdrop does.
    parallel_for(a.height, 8, [&](int64_t begin, int64_t end) {
      for (int64_t line = begin; line < end; ++line)
        for (int64_t column = 0; column < a.width; ++column)
          shade_pixel<cpu::PackTaps<T>>(a, column, line);
    });
  }
};

}  // namespace
}  // namespace gsf

GSF_REGISTER(CPU, gsf::ShadeOps<gsf::ShadeCpu>)
