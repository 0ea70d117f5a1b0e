// Collider operators, once for both back ends: checks, allocation, dtype dispatch.
#pragma once

#include "core/collider/args.h"
#include "torch_api.h"

namespace gsf {

template <class Backend>
struct ColliderOps {
  static std::tuple<Tensor, Tensor> collider_distance(Tensor position_in, Tensor colliders_in,
                                                      OptTensor sdf_in) {
    const char* op = "collider_distance";
    const Tensor position = ready(op, "position", position_in, position_in, {-1, 3});
    const Tensor colliders = ready(op, "colliders", colliders_in, position, {-1, kColliderColumns});
    const OptTensor sdf = ready(op, "sdf", sdf_in, position, {-1}, ScalarType::Float);
    const int64_t points = position.size(0), rows = colliders.size(0);
    const typename Backend::Scope scope(position);
    const Tensor out = new_empty(position, {points, rows}, position.scalar_type());
    const Tensor normal = new_empty(position, {points, rows, 3}, position.scalar_type());
    dispatch_floating(op, position, [&]<typename T>() {
      const ColliderDistanceArgs<T> a{cptr<T>(position),
                                      cptr<T>(colliders),
                                      cptr<float>(sdf),
                                      points,
                                      rows,
                                      sdf.has_value() ? sdf->size(0) : 0,
                                      mptr<T>(out),
                                      mptr<T>(normal)};
      Backend::collider_distance(a, scope);
    });
    return {out, normal};
  }

  static Tensor advance_colliders(Tensor colliders, Tensor impulse_in, double dt, double gravity_x,
                                  double gravity_y, double gravity_z) {
    const char* op = "advance_colliders";
    check_shape(op, "colliders", colliders, {-1, kColliderColumns});
    const int64_t rows = colliders.size(0);
    const Tensor impulse =
        ready(op, "impulse", impulse_in, colliders, {rows, 6}, ScalarType::Double);
    const typename Backend::Scope scope(colliders);
    const Tensor out = torch::stable::clone(gsf::contiguous(colliders));
    dispatch_floating(op, out, [&]<typename T>() {
      const AdvanceCollidersArgs<T> a{
          mptr<T>(out), cptr<double>(impulse), rows, dt, {gravity_x, gravity_y, gravity_z}};
      Backend::advance_colliders(a, scope);
    });
    return out;
  }

  static Tensor blade_sides(Tensor position_in, Tensor blades_in, Tensor cut_in, double reach) {
    const char* op = "blade_sides";
    const Tensor position = ready(op, "position", position_in, position_in, {-1, 3});
    const int64_t points = position.size(0);
    const Tensor blades = ready(op, "blades", blades_in, position, {-1, kBladeColumns});
    const Tensor cut = ready(op, "cut", cut_in, position, {points}, ScalarType::Int);
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

  static void register_all(Library& m) {
    GSF_IMPL(ColliderOps, collider_distance);
    GSF_IMPL(ColliderOps, advance_colliders);
    GSF_IMPL(ColliderOps, blade_sides);
  }
};

}  // namespace gsf
