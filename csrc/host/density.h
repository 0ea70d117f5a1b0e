// Checks, allocation and dtype dispatch of the density ops, once for both back ends.
#pragma once

#include "core/density.h"
#include "torch_api.h"

namespace gsf {

inline void check_density_nodes(const char* op, int64_t nodes) {
  STD_TORCH_CHECK(nodes >= 16 && nodes % 16 == 0 && nodes <= 1024, op,
                  ": nodes must be a multiple of 16 up to 1024, got ", nodes);
}

// A backend says whether it needs room for `units` and `shares` (kShares).
template <class Backend>
struct DensityOps {
  static Tensor occupancy(Tensor means, Tensor frame, int64_t nodes, double full) {
    const char* op = "occupancy";
    means = ready(op, "means", means, means, {-1, 3});
    frame = ready(op, "frame", frame, means, {4});
    check_density_nodes(op, nodes);
    STD_TORCH_CHECK(full > 0, op, ": full must be positive, got ", full);
    const int side = static_cast<int>(nodes);
    Tensor values =
        gsf::new_zeros(means, {density_level(side, kDensityLevels)}, means.scalar_type());
    const int64_t cells = Backend::kShares ? nodes * nodes * nodes : 0;
    Tensor units = gsf::new_zeros(means, {cells}, ScalarType::Long);
    const typename Backend::Scope scope(means);
    dispatch_floating(op, means, [&]<typename T>() {
      const DensityArgs<T> args{means.size(0), cptr<T>(means),  cptr<T>(frame),      side,
                                T(full),       mptr<T>(values), mptr<int64_t>(units)};
      Backend::occupancy(args, scope);
    });
    return values;
  }

  static Tensor splat_bulk(Tensor means, Tensor scales) {
    const char* op = "splat_bulk";
    means = ready(op, "means", means, means, {-1, 3});
    scales = ready(op, "scales", scales, means, {means.size(0), 3});
    Tensor out = gsf::new_zeros(means, {kBulkSize}, ScalarType::Double);
    Tensor shares =
        gsf::new_empty(means, {Backend::kShares ? kBulkShares * kBulkSums : 0}, ScalarType::Double);
    const typename Backend::Scope scope(means);
    dispatch_floating(op, means, [&]<typename T>() {
      const BulkArgs<T> args{means.size(0), cptr<T>(means), cptr<T>(scales), mptr<double>(out),
                             mptr<double>(shares)};
      Backend::splat_bulk(args, scope);
    });
    return out;
  }

  static Tensor density_normals(Tensor means, Tensor quats, Tensor scales, Tensor values,
                                Tensor frame, int64_t nodes, OptTensor eye) {
    const char* op = "density_normals";
    means = ready(op, "means", means, means, {-1, 3});
    const int64_t n = means.size(0);
    quats = ready(op, "quats", quats, means, {n, 4});
    scales = ready(op, "scales", scales, means, {n, 3});
    check_density_nodes(op, nodes);
    const int side = static_cast<int>(nodes), wide = side >> kDensityWide;
    values = ready(op, "values", values, means, {density_level(side, kDensityLevels)});
    frame = ready(op, "frame", frame, means, {4});
    eye = ready(op, "eye", eye, means, {3});
    const auto real = means.scalar_type();
    const int64_t cells = int64_t(side) * side * side, coarse = int64_t(wide) * wide * wide;
    Tensor out = gsf::new_empty(means, {n, 3}, real);
    Tensor smooth = gsf::new_empty(means, {2 * cells + coarse}, real);
    const typename Backend::Scope scope(means);
    dispatch_floating(op, means, [&]<typename T>() {
      if (n == 0) return;
      T* room = mptr<T>(smooth);
      const DensityNormalArgs<T> args{n,
                                      cptr<T>(means),
                                      cptr<T>(quats),
                                      cptr<T>(scales),
                                      cptr<T>(values),
                                      cptr<T>(frame),
                                      cptr<T>(eye),
                                      side,
                                      room,
                                      room + 2 * cells,
                                      room + cells,
                                      mptr<T>(out)};
      Backend::density_normals(args, scope);
    });
    return out;
  }

  static void register_all(Library& m) {
    GSF_IMPL(DensityOps, occupancy);
    GSF_IMPL(DensityOps, splat_bulk);
    GSF_IMPL(DensityOps, density_normals);
  }
};

}  // namespace gsf
