// MPM operators, once for both back ends: checks, allocation, dtype dispatch, then
// Backend::<kernel>(args, scope).
#pragma once

#include "core/mpm/args.h"
#include "torch_api.h"

namespace gsf {

template <class Backend>
struct MpmOps {
  using Ints = std::vector<int64_t>;

  // The index tensors of one Blocks, checked and contiguous; keeps them alive while kernels read
  // the pointers.
  struct BlockTensors {
    Tensor table, coords, order, start;
    BlockView view{};

    BlockTensors(const char* op, const Tensor& like, const Tensor& table_in,
                 const Tensor& coords_in, const Tensor& order_in, const Tensor& start_in,
                 const Ints& origin, int64_t margin, int64_t particles)
        : BlockTensors(op, like, table_in, coords_in, origin) {
      order = gsf::contiguous(order_in);
      start = gsf::contiguous(start_in);
      check_shape(op, "blocks.order", order, {particles});
      check_shape(op, "blocks.start", start, {coords.size(0) + 1});
      check(op, {&order, &start}, like);
      STD_TORCH_CHECK(margin >= 0 && margin <= 2, op, ": blocks.margin must be 0, 1 or 2, got ",
                      margin);
      view.order = cptr<int32_t>(order);
      view.start = cptr<int32_t>(start);
      view.particles = particles;
      view.margin = static_cast<int32_t>(margin);
    }

    // Nodes alone, without the particles.
    BlockTensors(const char* op, const Tensor& like, const Tensor& table_in,
                 const Tensor& coords_in, const Ints& origin)
        : table(gsf::contiguous(table_in)), coords(gsf::contiguous(coords_in)) {
      check_shape(op, "blocks.table", table, {-1, -1, -1});
      check_shape(op, "blocks.coords", coords, {-1, 3});
      check(op, {&table, &coords}, like);
      STD_TORCH_CHECK(origin.size() == 3, op, ": blocks.origin must have 3 numbers, got ",
                      origin.size());
      constexpr int64_t kFar = int64_t(1) << 28;  // block coordinates times 4 stay in int32
      for (int axis = 0; axis < 3; ++axis) {
        const int64_t size = table.size(axis);
        STD_TORCH_CHECK(origin[axis] > -kFar && origin[axis] + size < kFar, op,
                        ": blocks.origin is out of range");
        view.origin[axis] = static_cast<int32_t>(origin[axis]);
        view.size[axis] = static_cast<int32_t>(size);
      }
      view.table = cptr<int32_t>(table);
      view.coords = cptr<int32_t>(coords);
      view.count = coords.size(0);
    }

   private:
    static void check(const char* op, std::initializer_list<const Tensor*> all,
                      const Tensor& like) {
      for (const Tensor* t : all) {
        check_dtype(op, "blocks", *t, ScalarType::Int);
        check_same_device(op, "blocks", *t, like);
      }
    }
  };

  static OptTensor ready(const char* op, const char* name, const OptTensor& t, const Tensor& like,
                         std::initializer_list<int64_t> shape, ScalarType dtype) {
    if (!t.has_value()) return t;
    check_shape(op, name, *t, shape);
    check_dtype(op, name, *t, dtype);
    check_same_device(op, name, *t, like);
    return gsf::contiguous(*t);
  }
  static Tensor ready(const char* op, const char* name, const Tensor& t, const Tensor& like,
                      std::initializer_list<int64_t> shape) {
    return *ready(op, name, OptTensor(t), like, shape, like.scalar_type());
  }
  template <typename T>
  static const T* pointer(const OptTensor& t) {
    return t.has_value() ? cptr<T>(*t) : nullptr;
  }
  static void check_fields(const char* op, int64_t fields) {
    STD_TORCH_CHECK(fields >= 1 && fields <= kMaxFields, op, ": fields must be 1 to ", kMaxFields,
                    ", got ", fields);
  }

  static std::tuple<Tensor, Tensor, Tensor> p2g(Tensor position, Tensor velocity, Tensor affine,
                                                Tensor mass, OptTensor stress, OptTensor volume,
                                                OptTensor body, Tensor table, Tensor coords,
                                                Tensor order, Tensor start, Ints origin,
                                                int64_t margin, double dx, double dt,
                                                int64_t fields, bool contact) {
    const char* op = "p2g";
    const int64_t n = position.dim() > 0 ? position.size(0) : -1;
    const ScalarType type = position.scalar_type();
    const Tensor x = ready(op, "position", position, position, {n, 3});
    const Tensor v = ready(op, "velocity", velocity, x, {n, 3});
    const Tensor c = ready(op, "affine", affine, x, {n, 3, 3});
    const Tensor m = ready(op, "mass", mass, x, {n});
    const OptTensor tau = ready(op, "stress", stress, x, {n, 6}, type);
    const OptTensor vol = ready(op, "volume", volume, x, {n}, type);
    const OptTensor ids = ready(op, "body", body, x, {n}, ScalarType::Int);
    STD_TORCH_CHECK(tau.has_value() == vol.has_value(), op,
                    ": stress and volume must be given together");
    STD_TORCH_CHECK(dx > 0, op, ": dx must be positive, got ", dx);
    check_fields(op, fields);
    const BlockTensors b(op, x, table, coords, order, start, origin, margin, n);
    const typename Backend::Scope scope(x);
    const Tensor grid = new_zeros(x, {fields, b.view.count, kBlockNodes, 4}, type);
    const Tensor moments =
        new_zeros(x, {contact ? fields : 0, b.view.count, kBlockNodes, kContactMoments}, type);
    const Tensor skipped = new_zeros(x, {}, ScalarType::Long);
    dispatch_floating(op, x, [&]<typename T>() {
      P2GArgs<T> a{};
      a.blocks = b.view;
      a.position = cptr<T>(x);
      a.velocity = cptr<T>(v);
      a.affine = cptr<T>(c);
      a.mass = cptr<T>(m);
      a.stress = pointer<T>(tau);
      a.volume = pointer<T>(vol);
      a.body = pointer<int32_t>(ids);
      a.dx = static_cast<T>(dx);
      a.dt = static_cast<T>(dt);
      a.fields = static_cast<int32_t>(fields);
      a.grid = mptr<T>(grid);
      a.moments = contact ? mptr<T>(moments) : nullptr;
      a.skipped = mptr<int64_t>(skipped);
      Backend::p2g(a, scope);
    });
    return {grid, moments, skipped};
  }

  static std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> g2p(
      Tensor velocity_grid, Tensor position, OptTensor velocity, OptTensor deformation,
      OptTensor body, Tensor table, Tensor coords, Tensor order, Tensor start, Ints origin,
      int64_t margin, double dx, double dt) {
    const char* op = "g2p";
    const int64_t n = position.dim() > 0 ? position.size(0) : -1;
    const ScalarType type = position.scalar_type();
    const Tensor x = ready(op, "position", position, position, {n, 3});
    const BlockTensors b(op, x, table, coords, order, start, origin, margin, n);
    const Tensor grid =
        ready(op, "velocity_grid", velocity_grid, x, {-1, b.view.count, kBlockNodes, 3});
    const OptTensor v = ready(op, "velocity", velocity, x, {n, 3}, type);
    const OptTensor f = ready(op, "deformation", deformation, x, {n, 3, 3}, type);
    const OptTensor ids = ready(op, "body", body, x, {n}, ScalarType::Int);
    STD_TORCH_CHECK(dx > 0, op, ": dx must be positive, got ", dx);
    check_fields(op, grid.size(0));
    const typename Backend::Scope scope(x);
    const Tensor x_out = new_empty(x, {n, 3}, type);
    const Tensor v_out = new_empty(x, {n, 3}, type);
    const Tensor c_out = new_empty(x, {n, 3, 3}, type);
    const Tensor f_out = new_empty(x, {f.has_value() ? n : 0, 3, 3}, type);
    const Tensor skipped = new_zeros(x, {}, ScalarType::Long);
    dispatch_floating(op, x, [&]<typename T>() {
      GatherArgs<T> a{};
      a.blocks = b.view;
      a.grid = cptr<T>(grid);
      a.position = cptr<T>(x);
      a.body = pointer<int32_t>(ids);
      a.dx = static_cast<T>(dx);
      a.dt = static_cast<T>(dt);
      a.fields = static_cast<int32_t>(grid.size(0));
      a.skipped = mptr<int64_t>(skipped);
      a.velocity = pointer<T>(v);
      a.deformation = pointer<T>(f);
      a.position_out = mptr<T>(x_out);
      a.velocity_out = mptr<T>(v_out);
      a.affine_out = mptr<T>(c_out);
      a.deformation_out = f.has_value() ? mptr<T>(f_out) : nullptr;
      Backend::g2p(a, scope);
    });
    return {x_out, v_out, c_out, f_out, skipped};
  }

  // Adjoint of p2g: what the gradient of the grid says to each particle.
  static std::tuple<Tensor, Tensor> p2g_adjoint(Tensor grid_in, Tensor position, OptTensor body,
                                                Tensor table, Tensor coords, Tensor order,
                                                Tensor start, Ints origin, int64_t margin,
                                                double dx) {
    const char* op = "p2g_adjoint";
    const int64_t n = position.dim() > 0 ? position.size(0) : -1;
    const ScalarType type = position.scalar_type();
    const Tensor x = ready(op, "position", position, position, {n, 3});
    const BlockTensors b(op, x, table, coords, order, start, origin, margin, n);
    const Tensor grid = ready(op, "grid", grid_in, x, {-1, b.view.count, kBlockNodes, 4});
    const OptTensor ids = ready(op, "body", body, x, {n}, ScalarType::Int);
    STD_TORCH_CHECK(dx > 0, op, ": dx must be positive, got ", dx);
    check_fields(op, grid.size(0));
    const typename Backend::Scope scope(x);
    const Tensor value = new_empty(x, {n, 4}, type);
    const Tensor first = new_empty(x, {n, 3, 3}, type);
    const Tensor skipped = new_zeros(x, {}, ScalarType::Long);
    dispatch_floating(op, x, [&]<typename T>() {
      GatherArgs<T> a{};
      a.blocks = b.view;
      a.grid = cptr<T>(grid);
      a.position = cptr<T>(x);
      a.body = pointer<int32_t>(ids);
      a.dx = static_cast<T>(dx);
      a.fields = static_cast<int32_t>(grid.size(0));
      a.skipped = mptr<int64_t>(skipped);
      a.value_out = mptr<T>(value);
      a.first_out = mptr<T>(first);
      Backend::p2g_adjoint(a, scope);
    });
    return {value, first};
  }

  // Derivative of a transfer with respect to the particle positions.
  static Tensor transfer_slope(Tensor grid_in, Tensor constant_in, Tensor linear_in,
                               Tensor position, OptTensor body, Tensor table, Tensor coords,
                               Tensor order, Tensor start, Ints origin, int64_t margin, double dx) {
    const char* op = "transfer_slope";
    const int64_t n = position.dim() > 0 ? position.size(0) : -1;
    const ScalarType type = position.scalar_type();
    const Tensor x = ready(op, "position", position, position, {n, 3});
    const BlockTensors b(op, x, table, coords, order, start, origin, margin, n);
    const Tensor grid = ready(op, "grid", grid_in, x, {-1, b.view.count, kBlockNodes, 4});
    const Tensor constant = ready(op, "constant", constant_in, x, {n, 4});
    const Tensor linear = ready(op, "linear", linear_in, x, {n, 3, 3});
    const OptTensor ids = ready(op, "body", body, x, {n}, ScalarType::Int);
    STD_TORCH_CHECK(dx > 0, op, ": dx must be positive, got ", dx);
    check_fields(op, grid.size(0));
    const typename Backend::Scope scope(x);
    const Tensor slope = new_zeros(x, {n, 3}, type);
    const Tensor skipped = new_zeros(x, {}, ScalarType::Long);
    dispatch_floating(op, x, [&]<typename T>() {
      GatherArgs<T> a{};
      a.blocks = b.view;
      a.grid = cptr<T>(grid);
      a.position = cptr<T>(x);
      a.body = pointer<int32_t>(ids);
      a.dx = static_cast<T>(dx);
      a.fields = static_cast<int32_t>(grid.size(0));
      a.skipped = mptr<int64_t>(skipped);
      a.constant = cptr<T>(constant);
      a.linear = cptr<T>(linear);
      a.slope_out = mptr<T>(slope);
      Backend::transfer_slope(a, scope);
    });
    return slope;
  }

  static std::tuple<Tensor, Tensor, Tensor, Tensor> grid_update(
      Tensor grid_in, OptTensor moments, OptTensor colliders, OptTensor sdf, OptTensor merged,
      OptTensor cut, Tensor table, Tensor coords, Ints origin, double dx, double dt,
      double gravity_x, double gravity_y, double gravity_z, double friction, double restitution,
      double contact_gap) {
    const char* op = "grid_update";
    const int64_t fields = grid_in.dim() > 0 ? grid_in.size(0) : 0;
    check_fields(op, fields);
    const BlockTensors b(op, grid_in, table, coords, origin);
    const int64_t count = b.view.count;
    const ScalarType type = grid_in.scalar_type();
    const Tensor grid = ready(op, "grid", grid_in, grid_in, {fields, count, kBlockNodes, 4});
    const OptTensor mom =
        ready(op, "moments", moments, grid, {fields, count, kBlockNodes, kContactMoments}, type);
    const OptTensor rows = ready(op, "colliders", colliders, grid, {-1, kColliderColumns}, type);
    const OptTensor groups = ready(op, "merged", merged, grid, {fields}, ScalarType::Long);
    const OptTensor sides = ready(op, "cut", cut, grid, {fields}, ScalarType::Int);
    const OptTensor distances = ready(op, "sdf", sdf, grid, {-1}, ScalarType::Float);
    STD_TORCH_CHECK(dx > 0, op, ": dx must be positive, got ", dx);
    const int64_t rows_count = rows.has_value() ? rows->size(0) : 0;
    const typename Backend::Scope scope(grid);
    const Tensor velocity = new_empty(grid, {fields, count, kBlockNodes, 3}, type);
    const Tensor partial =
        new_empty(grid, {grid_update_chunks(count), rows_count, 6}, ScalarType::Double);
    const Tensor contact_mass = new_zeros(grid, {rows_count}, ScalarType::Double);
    const Tensor impulse = new_zeros(grid, {rows_count, 6}, ScalarType::Double);
    const Tensor contact_nodes = new_zeros(grid, {}, ScalarType::Long);
    dispatch_floating(op, grid, [&]<typename T>() {
      GridUpdateArgs<T> a{};
      a.blocks = b.view;
      a.coords = b.view.coords;
      a.count = count;
      a.fields = static_cast<int32_t>(fields);
      a.merged = reinterpret_cast<const uint64_t*>(pointer<int64_t>(groups));
      a.cut = pointer<int32_t>(sides);
      a.grid = cptr<T>(grid);
      a.moments = pointer<T>(mom);
      a.colliders = pointer<T>(rows);
      a.collider_count = rows_count;
      a.sdf = pointer<float>(distances);
      a.sdf_count = distances.has_value() ? distances->size(0) : 0;
      a.dx = static_cast<T>(dx);
      a.dt = static_cast<T>(dt);
      a.gravity[0] = static_cast<T>(gravity_x);
      a.gravity[1] = static_cast<T>(gravity_y);
      a.gravity[2] = static_cast<T>(gravity_z);
      a.law = {friction, restitution, contact_gap};
      a.velocity = mptr<T>(velocity);
      a.partial = mptr<double>(partial);
      a.contact_mass = mptr<double>(contact_mass);
      a.impulse = mptr<double>(impulse);
      a.contact_nodes = mptr<int64_t>(contact_nodes);
      Backend::grid_update(a, scope);
    });
    return {velocity, impulse, contact_mass, contact_nodes};
  }

  static void register_all(torch::stable::detail::StableLibrary& m) {
    m.impl("p2g", TORCH_BOX(&MpmOps::p2g));
    m.impl("g2p", TORCH_BOX(&MpmOps::g2p));
    m.impl("p2g_adjoint", TORCH_BOX(&MpmOps::p2g_adjoint));
    m.impl("grid_update", TORCH_BOX(&MpmOps::grid_update));
  }
};

}  // namespace gsf
