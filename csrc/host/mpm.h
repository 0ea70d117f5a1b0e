// MPM operators, once for both back ends: checks, allocation, dtype dispatch, then
// Backend::<kernel>(args, scope).
#pragma once

#include "core/mpm/args.h"
#include "torch_api.h"

namespace gsf {

// What build_blocks made, as it stands in the schemas of the transfers.
struct BlockArgs {
  Tensor table, coords, order, start;
  std::vector<int64_t> origin;
  int64_t margin;
};
template <>
struct Unbox<BlockArgs> {
  static constexpr uint64_t kValues = 6;
  static BlockArgs take(StableIValue*& at) {
    using Ints = std::vector<int64_t>;
    return {Unbox<Tensor>::take(at), Unbox<Tensor>::take(at), Unbox<Tensor>::take(at),
            Unbox<Tensor>::take(at), Unbox<Ints>::take(at),   Unbox<int64_t>::take(at)};
  }
};

template <class Backend>
struct MpmOps {
  // The index tensors of one Blocks, checked and contiguous; keeps them alive while kernels read
  // the pointers.
  struct BlockTensors {
    Tensor table, coords, order, start;
    BlockView view{};

    BlockTensors(const char* op, const Tensor& like, const BlockArgs& given, int64_t particles)
        : BlockTensors(op, like, given.table, given.coords, given.origin) {
      order = ready(op, "blocks.order", given.order, like, {particles}, ScalarType::Int);
      start = ready(op, "blocks.start", given.start, like, {coords.size(0) + 1}, ScalarType::Int);
      STD_TORCH_CHECK(given.margin >= 0 && given.margin <= 2, op,
                      ": blocks.margin must be 0, 1 or 2, got ", given.margin);
      view.order = cptr<int32_t>(order);
      view.start = cptr<int32_t>(start);
      view.particles = particles;
      view.margin = static_cast<int32_t>(given.margin);
    }

    // Nodes alone, without the particles.
    BlockTensors(const char* op, const Tensor& like, const Tensor& table_in,
                 const Tensor& coords_in, const std::vector<int64_t>& origin)
        : table(ready(op, "blocks.table", table_in, like, {-1, -1, -1}, ScalarType::Int)),
          coords(ready(op, "blocks.coords", coords_in, like, {-1, 3}, ScalarType::Int)) {
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
  };

  // What every transfer takes of its particles.
  struct Particles {
    int64_t count;
    Tensor x;
    BlockTensors blocks;
    OptTensor body;
    Tensor skipped;

    Particles(const char* op, const Tensor& position, const OptTensor& body_in,
              const BlockArgs& given, double dx)
        : count(position.dim() > 0 ? position.size(0) : -1),
          x(ready(op, "position", position, position, {count, 3})),
          blocks(op, x, given, count),
          body(ready(op, "body", body_in, x, {count}, ScalarType::Int)),
          skipped(new_zeros(x, {}, ScalarType::Long)) {
      STD_TORCH_CHECK(dx > 0, op, ": dx must be positive, got ", dx);
    }

    // The arguments of a kernel with these filled in.
    template <class Args>
    Args args(double dx, int64_t fields) const {
      using T = decltype(Args::dx);
      Args a{};
      a.blocks = blocks.view;
      a.position = cptr<T>(x);
      a.body = cptr<int32_t>(body);
      a.dx = static_cast<T>(dx);
      a.fields = static_cast<int32_t>(fields);
      a.skipped = mptr<int64_t>(skipped);
      return a;
    }
    // A grid that particles gather from.
    Tensor grid(const char* op, const char* name, const Tensor& in, int64_t channels) const {
      const Tensor grid = ready(op, name, in, x, {-1, blocks.view.count, kBlockNodes, channels});
      check_fields(op, grid.size(0));
      return grid;
    }
  };

  static void check_fields(const char* op, int64_t fields) {
    STD_TORCH_CHECK(fields >= 1 && fields <= kMaxFields, op, ": fields must be 1 to ", kMaxFields,
                    ", got ", fields);
  }

  static std::tuple<Tensor, Tensor, Tensor> p2g(Tensor position, Tensor velocity, Tensor affine,
                                                Tensor mass, OptTensor stress, OptTensor volume,
                                                OptTensor body, BlockArgs blocks, double dx,
                                                double dt, int64_t fields, bool contact) {
    const char* op = "p2g";
    const Particles p(op, position, body, blocks, dx);
    const int64_t n = p.count, count = p.blocks.view.count;
    const Tensor& x = p.x;
    const Tensor v = ready(op, "velocity", velocity, x, {n, 3});
    const Tensor c = ready(op, "affine", affine, x, {n, 3, 3});
    const Tensor m = ready(op, "mass", mass, x, {n});
    const OptTensor tau = ready(op, "stress", stress, x, {n, 6});
    const OptTensor vol = ready(op, "volume", volume, x, {n});
    STD_TORCH_CHECK(tau.has_value() == vol.has_value(), op,
                    ": stress and volume must be given together");
    check_fields(op, fields);
    const typename Backend::Scope scope(x);
    const Tensor grid = new_zeros(x, {fields, count, kBlockNodes, 4}, x.scalar_type());
    const Tensor moments =
        new_zeros(x, {contact ? fields : 0, count, kBlockNodes, kContactMoments}, x.scalar_type());
    dispatch_floating(op, x, [&]<typename T>() {
      auto a = p.template args<P2GArgs<T>>(dx, fields);
      a.velocity = cptr<T>(v);
      a.affine = cptr<T>(c);
      a.mass = cptr<T>(m);
      a.stress = cptr<T>(tau);
      a.volume = cptr<T>(vol);
      a.dt = static_cast<T>(dt);
      a.grid = mptr<T>(grid);
      a.moments = contact ? mptr<T>(moments) : nullptr;
      Backend::p2g(a, scope);
    });
    return {grid, moments, p.skipped};
  }

  static std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> g2p(Tensor velocity_grid,
                                                                Tensor position, OptTensor velocity,
                                                                OptTensor deformation,
                                                                OptTensor body, BlockArgs blocks,
                                                                double dx, double dt) {
    const char* op = "g2p";
    const Particles p(op, position, body, blocks, dx);
    const int64_t n = p.count;
    const Tensor& x = p.x;
    const Tensor grid = p.grid(op, "velocity_grid", velocity_grid, 3);
    const OptTensor v = ready(op, "velocity", velocity, x, {n, 3});
    const OptTensor f = ready(op, "deformation", deformation, x, {n, 3, 3});
    const typename Backend::Scope scope(x);
    const Tensor x_out = new_empty(x, {n, 3}, x.scalar_type());
    const Tensor v_out = new_empty(x, {n, 3}, x.scalar_type());
    const Tensor c_out = new_empty(x, {n, 3, 3}, x.scalar_type());
    const Tensor f_out = new_empty(x, {f.has_value() ? n : 0, 3, 3}, x.scalar_type());
    dispatch_floating(op, x, [&]<typename T>() {
      auto a = p.template args<GatherArgs<T>>(dx, grid.size(0));
      a.grid = cptr<T>(grid);
      a.dt = static_cast<T>(dt);
      a.velocity = cptr<T>(v);
      a.deformation = cptr<T>(f);
      a.position_out = mptr<T>(x_out);
      a.velocity_out = mptr<T>(v_out);
      a.affine_out = mptr<T>(c_out);
      a.deformation_out = f.has_value() ? mptr<T>(f_out) : nullptr;
      Backend::g2p(a, scope);
    });
    return {x_out, v_out, c_out, f_out, p.skipped};
  }

  // Adjoint of p2g: what the gradient of the grid says to each particle.
  static std::tuple<Tensor, Tensor> p2g_adjoint(Tensor grid_in, Tensor position, OptTensor body,
                                                BlockArgs blocks, double dx) {
    const char* op = "p2g_adjoint";
    const Particles p(op, position, body, blocks, dx);
    const Tensor grid = p.grid(op, "grid", grid_in, 4);
    const typename Backend::Scope scope(p.x);
    const Tensor value = new_empty(p.x, {p.count, 4}, p.x.scalar_type());
    const Tensor first = new_empty(p.x, {p.count, 3, 3}, p.x.scalar_type());
    dispatch_floating(op, p.x, [&]<typename T>() {
      auto a = p.template args<GatherArgs<T>>(dx, grid.size(0));
      a.grid = cptr<T>(grid);
      a.value_out = mptr<T>(value);
      a.first_out = mptr<T>(first);
      Backend::p2g_adjoint(a, scope);
    });
    return {value, first};
  }

  // Derivative of a transfer with respect to the particle positions.
  static Tensor transfer_slope(Tensor grid_in, Tensor constant_in, Tensor linear_in,
                               Tensor position, OptTensor body, BlockArgs blocks, double dx) {
    const char* op = "transfer_slope";
    const Particles p(op, position, body, blocks, dx);
    const Tensor grid = p.grid(op, "grid", grid_in, 4);
    const Tensor constant = ready(op, "constant", constant_in, p.x, {p.count, 4});
    const Tensor linear = ready(op, "linear", linear_in, p.x, {p.count, 3, 3});
    const typename Backend::Scope scope(p.x);
    const Tensor slope = new_zeros(p.x, {p.count, 3}, p.x.scalar_type());
    dispatch_floating(op, p.x, [&]<typename T>() {
      auto a = p.template args<GatherArgs<T>>(dx, grid.size(0));
      a.grid = cptr<T>(grid);
      a.constant = cptr<T>(constant);
      a.linear = cptr<T>(linear);
      a.slope_out = mptr<T>(slope);
      Backend::transfer_slope(a, scope);
    });
    return slope;
  }

  static std::tuple<Tensor, Tensor, Tensor, Tensor> grid_update(
      Tensor grid_in, OptTensor moments, OptTensor colliders, OptTensor sdf, OptTensor merged,
      OptTensor cut, Tensor table, Tensor coords, std::vector<int64_t> origin, double dx, double dt,
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
        ready(op, "moments", moments, grid, {fields, count, kBlockNodes, kContactMoments});
    const OptTensor rows = ready(op, "colliders", colliders, grid, {-1, kColliderColumns});
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
      a.merged = reinterpret_cast<const uint64_t*>(cptr<int64_t>(groups));
      a.cut = cptr<int32_t>(sides);
      a.grid = cptr<T>(grid);
      a.moments = cptr<T>(mom);
      a.colliders = cptr<T>(rows);
      a.collider_count = rows_count;
      a.sdf = cptr<float>(distances);
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

  static void register_all(Library& m) {
    GSF_IMPL_UNBOX(MpmOps, p2g);
    GSF_IMPL_UNBOX(MpmOps, g2p);
    GSF_IMPL_UNBOX(MpmOps, p2g_adjoint);
    GSF_IMPL(MpmOps, grid_update);
  }
};

}  // namespace gsf
