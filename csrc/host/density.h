// Checks, allocation and dtype dispatch of the density ops, once for both back ends.
#pragma once

#include "core/density.h"
#include "torch_api.h"

namespace gsf {

inline void check_density_nodes(const char* op, int64_t nodes) {
  STD_TORCH_CHECK(nodes >= 16 && nodes % 16 == 0 && nodes <= 1024, op,
                  ": nodes must be a multiple of 16 up to 1024, got ", nodes);
}

template <class Backend>
struct DensityOps {
  static Tensor occupancy(Tensor means, Tensor frame, int64_t nodes, double full) {
    const char* op = "occupancy";
    check_shape(op, "means", means, {-1, 3});
    check_shape(op, "frame", frame, {4});
    check_dtype(op, "frame", frame, means.scalar_type());
    check_same_device(op, "frame", frame, means);
    check_density_nodes(op, nodes);
    STD_TORCH_CHECK(full > 0, op, ": full must be positive, got ", full);
    means = gsf::contiguous(means);
    frame = gsf::contiguous(frame);
    const int side = static_cast<int>(nodes);
    Tensor values =
        gsf::new_zeros(means, {density_level(side, kDensityLevels)}, means.scalar_type());
    dispatch_floating(op, means, [&]<typename T>() {
      const DensityArgs<T> args{means.size(0), cptr<T>(means), cptr<T>(frame),
                                side,          T(full),        mptr<T>(values)};
      Backend::occupancy(args, means);
    });
    return values;
  }

  static Tensor bulk(Tensor means, Tensor scales) {
    const char* op = "splat_bulk";
    check_shape(op, "means", means, {-1, 3});
    check_shape(op, "scales", scales, {means.size(0), 3});
    check_dtype(op, "scales", scales, means.scalar_type());
    check_same_device(op, "scales", scales, means);
    means = gsf::contiguous(means);
    scales = gsf::contiguous(scales);
    Tensor out = gsf::new_zeros(means, {kBulkSize}, ScalarType::Double);
    dispatch_floating(op, means, [&]<typename T>() {
      const BulkArgs<T> args{means.size(0), cptr<T>(means), cptr<T>(scales), mptr<double>(out)};
      Backend::bulk(args, means);
    });
    return out;
  }

  static Tensor normals(Tensor means, Tensor quats, Tensor scales, Tensor values, Tensor frame,
                        int64_t nodes, OptTensor eye) {
    const char* op = "density_normals";
    check_shape(op, "means", means, {-1, 3});
    const int64_t n = means.size(0);
    check_shape(op, "quats", quats, {n, 4});
    check_shape(op, "scales", scales, {n, 3});
    check_density_nodes(op, nodes);
    const int side = static_cast<int>(nodes), wide = side >> kDensityWide;
    check_shape(op, "values", values, {density_level(side, kDensityLevels)});
    check_shape(op, "frame", frame, {4});
    for (Tensor* t : {&means, &quats, &scales, &values, &frame}) {
      check_dtype(op, "every tensor", *t, means.scalar_type());
      check_same_device(op, "every tensor", *t, means);
      *t = gsf::contiguous(*t);
    }
    if (eye) {
      check_shape(op, "eye", *eye, {3});
      check_dtype(op, "eye", *eye, means.scalar_type());
      check_same_device(op, "eye", *eye, means);
      eye = gsf::contiguous(*eye);
    }
    const auto real = means.scalar_type();
    const int64_t cells = int64_t(side) * side * side, coarse = int64_t(wide) * wide * wide;
    Tensor out = gsf::new_empty(means, {n, 3}, real);
    Tensor smooth = gsf::new_empty(means, {2 * cells + coarse}, real);
    dispatch_floating(op, means, [&]<typename T>() {
      if (n == 0) return;
      T* room = mptr<T>(smooth);
      const DensityNormalArgs<T> args{n,
                                      cptr<T>(means),
                                      cptr<T>(quats),
                                      cptr<T>(scales),
                                      cptr<T>(values),
                                      cptr<T>(frame),
                                      eye ? cptr<T>(*eye) : nullptr,
                                      side,
                                      room,
                                      room + 2 * cells,
                                      room + cells,
                                      mptr<T>(out)};
      Backend::normals(args, means);
    });
    return out;
  }
};

}  // namespace gsf
