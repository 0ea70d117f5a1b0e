// CPU kernels of the ops of a texture's synthesis.
#include "host/texture.h"

#include <vector>

namespace gsf {
namespace {

constexpr int64_t kGrain = 4096;

struct TextureCpu {
  using Scope = CpuScope;
  static constexpr bool kRows = false;

  static void rows_between(const RowsBetweenArgs& a, const Scope&) {
    parallel_for(a.items(), kGrain, [&](int64_t begin, int64_t end) {
      for (int64_t item = begin; item < end; ++item) row_between(a, item);
    });
  }

  static void quantile_shift(const QuantileShiftArgs& a, const Scope&) {
    std::vector<float> knots(a.knots), moves(a.knots);
    for (int64_t part = 0; part < a.parts; ++part)
      for (int64_t column = 0; column < a.columns; ++column) {
        for (int64_t i = 0; i < a.knots; ++i) {
          knots[i] = a.knot(part, i, column);
          moves[i] = a.move(part, i, column);
        }
        parallel_for(a.length, kGrain, [&](int64_t begin, int64_t end) {
          for (int64_t row = begin; row < end; ++row) {
            const int64_t at = (part * a.length + row) * a.columns + column;
            a.moves[at] = gsf::quantile_shift(
                a.values[at], a.knots, [&](int64_t i) { return knots[i]; },
                [&](int64_t i) { return moves[i]; });
          }
        });
      }
  }

  // Place by place: no two patches have the same voxel there.
  static void patch_votes(const PatchVotesArgs& a, const Scope&) {
    for (int64_t k = 0; k < a.places; ++k)
      parallel_for(a.count, kGrain, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; ++i) {
          const int64_t voxel = a.center[i] + a.offset[k];
          if (voxel >= 0 && voxel < a.voxels)
            patch_vote(a, i, k, a.total + 3 * voxel, a.share + voxel);
        }
      });
  }
};

}  // namespace
}  // namespace gsf

GSF_REGISTER(CPU, gsf::TextureOps<gsf::TextureCpu>)
