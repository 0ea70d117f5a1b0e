// Collider operators, once for both back ends: checks, allocation, dtype dispatch.
#pragma once

#include "core/collider/args.h"
#include "torch_api.h"

namespace gsf {

template <class Backend>
struct ColliderOps {
  static std::tuple<Tensor, Tensor> distance(Tensor position_in, Tensor colliders_in,
                                             OptTensor sdf_in) {
    const char* op = "collider_distance";
    check_shape(op, "position", position_in, {-1, 3});
    check_shape(op, "colliders", colliders_in, {-1, kColliderColumns});
    check_dtype(op, "colliders", colliders_in, position_in.scalar_type());
    check_same_device(op, "colliders", colliders_in, position_in);
    const Tensor position = gsf::contiguous(position_in);
    const Tensor colliders = gsf::contiguous(colliders_in);
    OptTensor sdf = sdf_in;
    if (sdf.has_value()) {
      check_shape(op, "sdf", *sdf, {-1});
      check_dtype(op, "sdf", *sdf, ScalarType::Float);
      check_same_device(op, "sdf", *sdf, position);
      sdf = gsf::contiguous(*sdf);
    }
    const int64_t points = position.size(0), rows = colliders.size(0);
    const typename Backend::Scope scope(position);
    const Tensor out = new_empty(position, {points, rows}, position.scalar_type());
    const Tensor normal = new_empty(position, {points, rows, 3}, position.scalar_type());
    dispatch_floating(op, position, [&]<typename T>() {
      const ColliderDistanceArgs<T> a{cptr<T>(position),
                                      cptr<T>(colliders),
                                      sdf.has_value() ? cptr<float>(*sdf) : nullptr,
                                      points,
                                      rows,
                                      sdf.has_value() ? sdf->size(0) : 0,
                                      mptr<T>(out),
                                      mptr<T>(normal)};
      Backend::distance(a, scope);
    });
    return {out, normal};
  }

  static Tensor advance(Tensor colliders, Tensor impulse_in, double dt, double gravity_x,
                        double gravity_y, double gravity_z) {
    const char* op = "advance_colliders";
    check_shape(op, "colliders", colliders, {-1, kColliderColumns});
    const int64_t rows = colliders.size(0);
    check_shape(op, "impulse", impulse_in, {rows, 6});
    check_dtype(op, "impulse", impulse_in, ScalarType::Double);
    check_same_device(op, "impulse", impulse_in, colliders);
    const Tensor impulse = gsf::contiguous(impulse_in);
    const typename Backend::Scope scope(colliders);
    const Tensor out = torch::stable::clone(gsf::contiguous(colliders));
    dispatch_floating(op, out, [&]<typename T>() {
      const AdvanceCollidersArgs<T> a{
          mptr<T>(out), cptr<double>(impulse), rows, dt, {gravity_x, gravity_y, gravity_z}};
      Backend::advance(a, scope);
    });
    return out;
  }

  static Tensor blade_sides(Tensor position_in, Tensor blades_in, Tensor cut_in, double reach) {
    const char* op = "blade_sides";
    check_shape(op, "position", position_in, {-1, 3});
    const int64_t points = position_in.size(0);
    check_shape(op, "blades", blades_in, {-1, kBladeColumns});
    check_dtype(op, "blades", blades_in, position_in.scalar_type());
    check_same_device(op, "blades", blades_in, position_in);
    check_shape(op, "cut", cut_in, {points});
    check_dtype(op, "cut", cut_in, ScalarType::Int);
    check_same_device(op, "cut", cut_in, position_in);
    const Tensor position = gsf::contiguous(position_in), blades = gsf::contiguous(blades_in);
    const Tensor cut = gsf::contiguous(cut_in);
    const typename Backend::Scope scope(position);
    const Tensor out = new_empty(position, {points}, ScalarType::Int);
    dispatch_floating(op, position, [&]<typename T>() {
      const BladeSidesArgs<T> a{
          cptr<T>(position), cptr<T>(blades),       cptr<int32_t>(cut), points,
          blades.size(0),    static_cast<T>(reach), mptr<int32_t>(out)};
      Backend::blade_sides(a, scope);
    });
    return out;
  }

  static void register_all(torch::stable::detail::StableLibrary& m) {
    m.impl("collider_distance", TORCH_BOX(&ColliderOps::distance));
    m.impl("advance_colliders", TORCH_BOX(&ColliderOps::advance));
    m.impl("blade_sides", TORCH_BOX(&ColliderOps::blade_sides));
  }
};

}  // namespace gsf
