// CPU back end of SSIM and of the photometric loss: threads over bands of rows, strips of columns
// within; the rectangle is in ssim_tile.h.
#include "host/ssim.h"

#include <memory>

#include "cpu/train/ssim_tile.h"

namespace gsf {
namespace {

// Values of a strip's row: 77 of them (11 rows of 7 planes) fill about half a megabyte.
constexpr int64_t kStripValues = 1536;
// Rows of a band; each recomputes 20 rows of its neighbours.
constexpr int64_t kBandRows = 32;

struct SsimCpu {
  using Scope = CpuScope;
  template <typename T>
  static void run(const SsimArgs<T>& a, const Scope&) {
    const int64_t columns = std::max<int64_t>(kStripValues / a.channels, 64);
    const int64_t strips = (a.width + columns - 1) / columns;
    // Sums per row and strip, added below in one order: bands may end anywhere.
    const std::unique_ptr<ssim_cpu::RowSums[]> sums(
        new ssim_cpu::RowSums[static_cast<size_t>(strips * a.height)]());
    parallel_for(a.height, kBandRows, [&](int64_t begin, int64_t end) {
      for (int64_t s = 0; s < strips; ++s)
        ssim_cpu::Tile<T>(a, begin, end, s * columns, std::min((s + 1) * columns, a.width),
                          sums.get() + s * a.height)
            .run();
    });
    if (a.loss == nullptr) return;
    double total[kSsimSums] = {};
    for (int64_t i = 0; i < strips * a.height; ++i)
      for (int q = 0; q < kSsimSums; ++q) total[q] += sums[i][q];
    ssim_finish(a, total);
  }
};

}  // namespace
}  // namespace gsf

GSF_REGISTER(CPU, gsf::SsimOps<gsf::SsimCpu>)
