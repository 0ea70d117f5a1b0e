// The rasterizer on the CPU: threads over tiles, vector lanes over pixels. Registration and the
// driver loops; the tile kernels are in raster_tile.h, the ordering in raster_bin.h.
#include "host/raster.h"

#include <algorithm>

#include "cpu/raster_bin.h"
#include "cpu/raster_tile.h"

namespace gsf {
namespace {

using namespace raster_cpu;

// Calls f with the compile-time feature count (0: only known at run time) and whether sibling
// groups are in play. Only float has fast instances: double is there for checking.
template <typename T, typename F>
void with_variant(int features, bool groups, const F& f) {
  const auto choose = [&]<int kF>() {
    if (groups)
      f.template operator()<kF, true>();
    else
      f.template operator()<kF, false>();
  };
  if constexpr (sizeof(T) == sizeof(float)) {
    if (features == 3) return choose.template operator()<3>();  // rgb (adjoint)
    if (features == 4) return choose.template operator()<4>();  // rgb, depth
    if (features == 7) return choose.template operator()<7>();  // rgb, normal, depth
  }
  choose.template operator()<0>();
}

struct RasterCpu {
  struct Scope {
    explicit Scope(const Tensor&) {}
  };

  template <typename T>
  class Plan {
   public:
    Plan(const RasterArgs<T>& a, const Tensor&, const Scope&)
        : a_(a), visible_(project_and_sort(a)), lists_(a, visible_) {}

    int64_t instance_count() const { return lists_.total(); }

    void blend() {
      lists_.fill();
      std::vector<int64_t> first_slot;
      std::unique_ptr<T[]> slots;
      if (a_.contribution) {
        first_slot = instance_offsets(a_, visible_);
        slots.reset(new T[static_cast<size_t>(lists_.total())]);
      }
      const std::vector<int32_t> tiles = tiles_by_work(a_);
      with_variant<T>(a_.features, a_.groups != nullptr, [&]<int kF, bool kGroups>() {
        dynamic_for(static_cast<int64_t>(tiles.size()), [&](int64_t k) {
          blend_tile<T, kF, kGroups>(a_, tiles[k], first_slot.data(), slots.get());
        });
      });
      if (!a_.contribution) return;
      parallel_for(visible_, 2048, [&](int64_t begin, int64_t end) {
        for (int64_t r = begin; r < end; ++r) {
          T sum = T(0);
          for (int64_t s = first_slot[r]; s < first_slot[r + 1]; ++s) sum += slots[s];
          a_.contribution[a_.order[r]] = sum;
        }
      });
    }

   private:
    const RasterArgs<T>& a_;
    int64_t visible_;
    TileLists<T> lists_;
  };

  template <typename T>
  static void backward(const RasterGradArgs<T>& b, const Tensor&, const Scope&) {
    const RasterArgs<T>& a = b.forward;
    const int64_t visible = visible_count(a);
    const std::vector<int64_t> first_slot = instance_offsets(a, visible);
    STD_TORCH_CHECK(first_slot[visible] == a.instance_count && lists_are_sound(a, visible),
                    kRasterOp, ": saved state does not belong to these inputs");
    // Features are colours, normal, depth: those behind the last wanted one are left out.
    const int active = b.grad_depth ? a.features : a.channels + (b.grad_normal ? 3 : 0);
    const int width = kGradFeatures + active;
    std::unique_ptr<T[]> slots(new T[static_cast<size_t>(a.instance_count) * width]);
    const std::vector<int32_t> tiles = tiles_by_work(a);
    std::vector<T> background(b.grad_background ? tiles.size() * a.channels : 0, T(0));
    with_variant<T>(active, a.groups != nullptr, [&]<int kF, bool kGroups>() {
      dynamic_for(static_cast<int64_t>(tiles.size()), [&](int64_t k) {
        T* share = background.empty() ? nullptr : background.data() + tiles[k] * a.channels;
        blend_tile_backward<T, kF, kGroups>(b, tiles[k], active, first_slot.data(), slots.get(),
                                            share);
      });
    });
    for (size_t k = 0; k < background.size(); ++k)
      b.grad_background[k % a.channels] += background[k];

    // In the order of the inputs, where all memory but the splat's own row and slots is sequential.
    const SplatCamera<T> camera = raster_camera(a);
    std::vector<int32_t> rank_of(static_cast<size_t>(a.count), -1);
    for (int64_t r = 0; r < visible; ++r) rank_of[a.order[r]] = static_cast<int32_t>(r);
    parallel_for(a.count, 512, [&](int64_t begin, int64_t end) {
      constexpr int64_t kAhead = 8;
      for (int64_t i = begin; i < end; ++i) {
        if (i + kAhead < end && rank_of[i + kAhead] >= 0) {
          const int32_t next = rank_of[i + kAhead];
          __builtin_prefetch(a.splats + int64_t(next) * a.stride);
          __builtin_prefetch(slots.get() + first_slot[next] * width);
        }
        const int32_t r = rank_of[i];
        if (r < 0) continue;
        reduce_splat(b, camera, i, a.splats + int64_t(r) * a.stride, active,
                     slots.get() + first_slot[r] * width, first_slot[r + 1] - first_slot[r]);
      }
    });
  }

  // Sums a splat's rows of slots in order, turns moments into gradients of the projected splat and
  // takes those to the inputs.
  template <typename T>
  static void reduce_splat(const RasterGradArgs<T>& b, const SplatCamera<T>& camera, int64_t i,
                           const T* row, int active, const T* slots, int64_t count) {
    const RasterArgs<T>& a = b.forward;
    const int width = kGradFeatures + active;
    T sum[kGradFeatures + kMaxFeatures] = {};
    for (int64_t s = 0; s < count; ++s)
      for (int k = 0; k < width; ++k) sum[k] += slots[s * width + k];
    bool any = false;
    for (int k = 0; k < width; ++k) any = any || sum[k] != T(0);
    if (!any) return;
    T g[kGradFeatures + kMaxFeatures] = {};
    g[0] = row[kConicA] * sum[0] + row[kConicB] * sum[1];
    g[1] = row[kConicB] * sum[0] + row[kConicC] * sum[1];
    g[2] = T(-0.5) * sum[2];
    g[3] = -sum[3];
    g[4] = T(-0.5) * sum[4];
    g[5] = sum[5] / row[kOpacity];
    std::copy_n(sum + kGradFeatures, active, g + kGradFeatures);
    project_splat_backward(b, camera, i, g);
  }
};

}  // namespace
}  // namespace gsf

STABLE_TORCH_LIBRARY_IMPL(gsfluent, CPU, m) {
  using Ops = gsf::RasterOps<gsf::RasterCpu>;
  m.impl("rasterize", TORCH_BOX(&Ops::forward));
  m.impl("rasterize_backward", TORCH_BOX(&Ops::backward));
}
