// The rasterizer on the CPU: threads over tiles of all cameras, vector lanes over pixels.
// Registration and the driver loops; ordering is in bin.h, the tile kernels in tile.h
// and grad.h.
#include "host/raster.h"

#include "cpu/raster/bin.h"
#include "cpu/raster/grad.h"

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
    if (features == 3) return choose.template operator()<3>();  // rgb
    if (features == 4) return choose.template operator()<4>();  // rgb, depth
    if (features == 7) return choose.template operator()<7>();  // rgb, normal, depth
    if (features == 9) return choose.template operator()<9>();  // and the gloss of a splat
  }
  choose.template operator()<0>();
}

struct RasterCpu {
  static constexpr int kTile = kTileEdge;
  static constexpr bool kSavesOrder = true;
  static constexpr bool kWritesGradients = true;
  static int stride(int features) { return row_stride(features); }
  using Scope = CpuScope;

  template <typename T>
  class Plan {
   public:
    Plan(const RasterArgs<T>& a, const Tensor&, const Scope&) : a_(a), lists_(a) {}

    int64_t instance_count() const { return lists_.total(); }

    void blend() {
      lists_.fill();
      std::unique_ptr<T[]> slots;
      if (a_.contribution) slots.reset(new T[static_cast<size_t>(lists_.total())]);
      const std::vector<int32_t> tiles = tiles_by_work(a_);
      with_variant<T>(a_.features, a_.groups != nullptr, [&]<int kF, bool kGroups>() {
        dynamic_for(static_cast<int64_t>(tiles.size()), [&](int64_t k) {
          blend_tile<T, kF, kGroups>(a_, tiles[k], lists_.depth(), slots.get());
        });
      });
      if (!a_.contribution) return;
      parallel_for(a_.count, 2048, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; ++i) {
          T sum = T(0);
          for (int64_t s = i; s < a_.splat_count(); s += a_.count) {
            const int64_t next = s + 1 < a_.splat_count() ? a_.order[s + 1] : lists_.total();
            for (int64_t slot = a_.order[s]; slot < next; ++slot) sum += slots[slot];
          }
          a_.contribution[i] = sum;
        }
      });
    }

   private:
    const RasterArgs<T>& a_;
    TileLists<T> lists_;
  };

  template <typename T>
  static void backward(const RasterGradArgs<T>& b, const Tensor&, const Scope&) {
    const RasterArgs<T>& a = b.forward;
    constexpr const char* kUnsound = ": saved state does not belong to these inputs";
    STD_TORCH_CHECK(lists_are_sound(a), kRasterOp, kUnsound);
    std::atomic<bool> unsound{false};
    GradSlots<T> slots;
    slots.unsound = &unsound;
    slots.active = b.grad_depth ? a.features : a.channels + (b.grad_normal ? a.vectors : 0);
    slots.width = kGradFeatures + slots.active + (b.grad_absolute ? 2 : 0);
    const Scratch<T> rows(static_cast<size_t>(a.instance_count) * slots.width);
    slots.rows = rows.get();
    const std::vector<int32_t> tiles = tiles_by_work(a);
    std::vector<T> background(b.grad_background ? tiles.size() * a.channels : 0, T(0));
    const auto run = [&]<int kF, bool kGroups, bool kAbsolute>() {
      dynamic_for(static_cast<int64_t>(tiles.size()), [&](int64_t k) {
        T* share = background.empty() ? nullptr : background.data() + tiles[k] * a.channels;
        blend_tile_backward<T, kF, kGroups, kAbsolute>(b, tiles[k], slots, share);
      });
    };
    with_variant<T>(slots.active, a.groups != nullptr, [&]<int kF, bool kGroups>() {
      if (!b.grad_absolute)
        run.template operator()<kF, kGroups, false>();
      else
        run.template operator()<kF == 3 ? 3 : 0, kGroups, true>();
    });
    STD_TORCH_CHECK(!unsound, kRasterOp, kUnsound);
    for (size_t k = 0; k < background.size(); ++k) {
      const size_t camera = k / a.channels / a.tiles();
      b.grad_background[camera * a.background_stride + k % a.channels] += background[k];
    }

    // In the order of the inputs, where all memory is sequential.
    const std::vector<SplatCamera<T>> cameras = raster_cameras(a);
    parallel_for(a.count, 512, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; i += kPacket<T>)
        packet_backward(b, cameras,
                        PacketRows<T>{i, a.count, int(std::min<int64_t>(kPacket<T>, end - i))},
                        slots);
    });
  }
};

}  // namespace
}  // namespace gsf

GSF_REGISTER(CPU, gsf::RasterOps<gsf::RasterCpu>)
