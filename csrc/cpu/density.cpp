// CPU kernels of the density ops. Layers of the grid are shared out to the threads; each adds its
// splats in their order, so the sums do not depend on how many threads there are.
#include "host/density.h"

#include <algorithm>
#include <vector>

namespace gsf {
namespace {

struct DensityCpu {
  using Scope = CpuScope;
  static constexpr bool kShares = false;
  template <typename T>
  static void occupancy(const DensityArgs<T>& a, const Scope&) {
    const int64_t n = a.nodes, layer = n * n;
    parallel_for(n, (n + 15) / 16, [&](int64_t begin, int64_t end) {
      for (int64_t i = 0; i < a.count; ++i) {
        DensityPlace<T> place;
        if (!place.of(a.frame, a.nodes, a.means + 3 * i)) continue;
        if (place.z + 1 < begin || place.z >= end) continue;
        for (int corner = 0; corner < 8; ++corner) {
          const int z = place.z + (corner >> 2);
          if (z >= begin && z < end) a.values[place.cell(corner, a.nodes)] += place.weight(corner);
        }
      }
      const T share = T(1) / a.full;
      for (int64_t k = begin * layer; k < end * layer; ++k)
        a.values[k] = min(a.values[k] * share, T(1));
    });
    for (int level = 1; level < kDensityLevels; ++level) {
      const T* fine = a.values + density_level(a.nodes, level - 1);
      T* coarse = a.values + density_level(a.nodes, level);
      const int64_t side = a.nodes >> level, twice = 2 * side;
      parallel_for(side, 8, [&](int64_t begin, int64_t end) {
        for (int64_t z = begin; z < end; ++z)
          for (int64_t y = 0; y < side; ++y)
            for (int64_t x = 0; x < side; ++x) {
              T sum = T(0);
              for (int c = 0; c < 8; ++c)
                sum += fine[((2 * z + (c >> 2)) * twice + 2 * y + (c >> 1 & 1)) * twice + 2 * x +
                            (c & 1)];
              coarse[(z * side + y) * side + x] = T(0.125) * sum;
            }
      });
    }
  }

  template <typename T>
  static void splat_bulk(const BulkArgs<T>& a, const Scope&) {
    // Pieces of fixed size, added up in order: the same for any number of threads.
    constexpr int64_t kPiece = 65536;
    const int64_t pieces = (a.count + kPiece - 1) / kPiece;
    std::vector<double> sums(pieces * kBulkSums, 0.0);
    const auto each = [&](const auto& work) {
      parallel_for(pieces, 1, [&](int64_t begin, int64_t end) {
        for (int64_t p = begin; p < end; ++p)
          for (int64_t i = p * kPiece; i < std::min(a.count, (p + 1) * kPiece); ++i)
            work(i, &sums[p * kBulkSums]);
      });
    };
    each([&](int64_t i, double* sum) { bulk_terms(a, i, sum); });
    double total[kBulkSums] = {};
    for (size_t k = 0; k < sums.size(); ++k) total[k % kBulkSums] += sums[k];
    bulk_finish(total, a.out);
    std::fill(sums.begin(), sums.end(), 0.0);
    each([&](int64_t i, double* most) { *most = max(*most, bulk_away(a, i)); });
    for (int64_t p = 0; p < pieces; ++p) a.out[4] = max(a.out[4], sums[p * kBulkSums]);
    a.out[4] = std::sqrt(a.out[4]);
  }

  // Binomial smoothing of a cube along x, y and z; the last step ends in `out`.
  template <typename T, int kPasses>
  static void smooth(const T* in, T* out, T* spare, int64_t side) {
    T weight[2 * kPasses + 1];
    for (int k = -kPasses; k <= kPasses; ++k) weight[k + kPasses] = binomial_weight<T>(kPasses, k);
    const int64_t layer = side * side;
    const auto along = [&](const T* from, T* to, int64_t step) {
      parallel_for(side, 4, [&](int64_t begin, int64_t end) {
        for (int64_t z = begin; z < end; ++z)
          for (int64_t y = 0; y < side; ++y) {
            T* row = to + z * layer + y * side;
            const T* center = from + z * layer + y * side;
            std::fill_n(row, side, T(0));
            for (int k = -kPasses; k <= kPasses; ++k) {
              const int64_t at = step == 1 ? 0 : (step == side ? y : z) + k;
              if (at < 0 || at >= side) continue;
              const T w = weight[k + kPasses];
              const T* other = center + k * step;
              const int64_t first = step == 1 ? std::max<int64_t>(0, -k) : 0;
              const int64_t last = step == 1 ? std::min<int64_t>(side, side - k) : side;
              for (int64_t x = first; x < last; ++x) row[x] += w * other[x];
            }
          }
      });
    };
    along(in, out, 1);
    along(out, spare, side);
    along(spare, out, layer);
  }

  template <typename T>
  static void density_normals(const DensityNormalArgs<T>& a, const Scope&) {
    smooth<T, kDensityPasses>(a.values, a.fine, a.spare, a.nodes);
    smooth<T, 1>(a.values + density_level(a.nodes, kDensityWide), a.wide, a.spare,
                 a.nodes >> kDensityWide);
    parallel_for(a.count, 1024, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) density_normal(a, i);
    });
  }
};

}  // namespace
}  // namespace gsf

GSF_REGISTER(CPU, gsf::DensityOps<gsf::DensityCpu>)
