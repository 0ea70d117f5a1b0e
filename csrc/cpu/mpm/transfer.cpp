// CPU kernels of the MPM transfers. Blocks of one colour in parallel, each into its own tile: every
// node receives its sums in an order that does not depend on the number of threads.
#include <algorithm>
#include <atomic>

#include "cpu/mpm/grid_update.h"
#include "cpu/mpm/lanes.h"
#include "cpu/mpm/tile.h"
#include "host/mpm.h"

namespace gsf {
namespace cpu {
namespace {

constexpr int64_t kBlockGrain = 4;
constexpr int64_t kAhead = 8;  // particles; they are read through `order`, in any memory order

inline void fetch(const void* p) { __builtin_prefetch(p); }

template <typename T>
void fetch_particle(const P2GArgs<T>& a, int64_t r, int64_t end) {
  if (r >= end) return;
  const int64_t p = a.blocks.order[r];  // a prefetch of a wrong address does nothing
  fetch(a.position + 3 * p);
  fetch(a.velocity + 3 * p);
  fetch(a.affine + 9 * p);
  fetch(a.affine + 9 * p + 8);
  fetch(a.mass + p);
  if (a.stress == nullptr) return;
  fetch(a.stress + 6 * p);
  fetch(a.volume + p);
}

template <typename T>
void fetch_particle(const GatherArgs<T>& a, int64_t r, int64_t end) {
  if (r >= end) return;
  const int64_t p = a.blocks.order[r];
  fetch(a.position + 3 * p);
  if (a.deformation != nullptr) fetch(a.deformation + 9 * p);
  if (a.position_out == nullptr) return;
  __builtin_prefetch(a.position_out + 3 * p, 1);
  __builtin_prefetch(a.velocity_out + 3 * p, 1);
  __builtin_prefetch(a.affine_out + 9 * p, 1);
}

template <typename T>
ParticleMomentum<T> momentum_of(const P2GArgs<T>& a, const Stencil<T>& s, int64_t p) {
  const T* stress = a.stress != nullptr ? a.stress + 6 * p : nullptr;
  const T volume = a.stress != nullptr ? a.volume[p] : T(0);
  return particle_momentum(s, a.mass[p], a.velocity + 3 * p, a.affine + 9 * p, stress, volume, a.dx,
                           a.dt);
}

// One particle straight to the grid, for those that left their block's window; called from one
// thread only.
template <typename T>
bool scatter_stray(const P2GArgs<T>& a, int64_t p) {
  int32_t field;
  Stencil<T> s;
  StencilBlocks at;
  if (!locate_particle(a, true, p, field, s, at)) return false;
  Lanes<T> tile[27] = {};
  Lanes<T> moment[27] = {};
  scatter_momentum(momentum_of(a, s, p), s, tile, 3);
  if (a.moments != nullptr) scatter_moments(s, a.mass[p], moment, 3);
  const int64_t base = int64_t(field) * a.blocks.count * kBlockNodes;
  for_each_node([&](int i, int j, int k) {
    const int n = 9 * i + 3 * j + k;
    const int64_t node = base + at.node(s, i, j, k);
    for (int c = 0; c < 4; ++c) a.grid[4 * node + c] += tile[n][c];
    if (a.moments == nullptr) return;
    for (int c = 0; c < kContactMoments; ++c) a.moments[kContactMoments * node + c] += moment[n][c];
  });
  return true;
}

// Scatters the particles of one block; returns how many it could not place in the block's window.
template <typename T>
int32_t p2g_block(const P2GArgs<T>& a, int64_t block, std::vector<Lanes<T>>& tile,
                  std::vector<Lanes<T>>& moment) {
  const BlockView& view = a.blocks;
  const OrderRange range(view, block);
  if (range.begin == range.end) return 0;
  const Window window(view, block);
  if (!window.sound()) return static_cast<int32_t>(range.end - range.begin);
  const NodeRange nodes = view.node_range();
  const T inv_dx = T(1) / a.dx;
  const int32_t edge = window.edge();
  int64_t placed = 0;
  for (uint64_t left = fields_in(view, range, a.body, a.fields); left != 0; left &= left - 1) {
    const int32_t field = __builtin_ctzll(left);
    tile.assign(window.nodes(), Lanes<T>{});
    if (a.moments != nullptr) moment.assign(window.nodes(), Lanes<T>{});
    for (int64_t r = range.begin; r < range.end; ++r) {
      fetch_particle(a, r + kAhead, range.end);
      const int64_t p = view.order[r];
      if (p < 0 || p >= view.particles) continue;
      if (a.body != nullptr && a.body[p] != field) continue;
      Stencil<T> s;
      if (!make_stencil(a.position + 3 * p, inv_dx, nodes, s)) continue;
      const int32_t o = window.offset(s);
      if (o < 0) continue;
      ++placed;
      scatter_momentum(momentum_of(a, s, p), s, tile.data() + o, edge);
      if (a.moments != nullptr) scatter_moments(s, a.mass[p], moment.data() + o, edge);
    }
    const int64_t base = int64_t(field) * view.count * kBlockNodes;
    window.for_each_run([&](int32_t t, int64_t node, int32_t run) {
      T* out = a.grid + 4 * (base + node);
      for (int32_t n = 0; n < run; ++n)
        for (int c = 0; c < 4; ++c) out[4 * n + c] += tile[t + n][c];
      if (a.moments == nullptr) return;
      T* mom = a.moments + kContactMoments * (base + node);
      for (int32_t n = 0; n < run; ++n)
        for (int c = 0; c < kContactMoments; ++c) mom[kContactMoments * n + c] += moment[t + n][c];
    });
  }
  return static_cast<int32_t>(range.end - range.begin - placed);
}

template <typename T>
void p2g(const P2GArgs<T>& a) {
  const BlockView& view = a.blocks;
  const int32_t stride = color_stride(view.margin);
  const int32_t colors = stride * stride * stride;
  // Blocks listed by colour, in block order within a colour.
  std::vector<std::vector<int32_t>> list(colors);
  for (int64_t b = 0; b < view.count; ++b) {
    if (view.start[b] == view.start[b + 1]) continue;
    int32_t color = 0;
    for (int axis = 0; axis < 3; ++axis) {
      const int32_t c = view.coords[3 * b + axis] % stride;
      color = color * stride + (c < 0 ? c + stride : c);
    }
    list[color].push_back(static_cast<int32_t>(b));
  }
  std::vector<int32_t> unplaced(view.count, 0);
  for (const std::vector<int32_t>& blocks : list)
    parallel_for(static_cast<int64_t>(blocks.size()), kBlockGrain, [&](int64_t begin, int64_t end) {
      std::vector<Lanes<T>> tile, moment;
      for (int64_t i = begin; i < end; ++i)
        unplaced[blocks[i]] = p2g_block(a, blocks[i], tile, moment);
    });
  // Strays are few: one thread, block order.
  for (int64_t b = 0; b < view.count; ++b) {
    if (unplaced[b] == 0) continue;
    const OrderRange range(view, b);
    const Window window(view, b);
    for (int64_t r = range.begin; r < range.end; ++r) {
      const int64_t p = view.order[r];
      if (p < 0 || p >= view.particles) {
        ++*a.skipped;
        continue;
      }
      Stencil<T> s;
      const int32_t field = a.body != nullptr ? a.body[p] : 0;
      const bool placed = window.sound() && field >= 0 && field < a.fields &&
                          make_stencil(a.position + 3 * p, T(1) / a.dx, view.node_range(), s) &&
                          window.offset(s) >= 0;
      if (!placed && !scatter_stray(a, p)) ++*a.skipped;
    }
  }
}

template <typename T>
struct VelocityGather {
  static constexpr int kChannels = 3;
  static void visit(const GatherArgs<T>& a, int64_t p, const Stencil<T>& s, const Lanes<T>* node,
                    int32_t edge) {
    store(a, p, gather(s, a.dx, node, edge));
  }
  static void store(const GatherArgs<T>& a, int64_t p, const Gathered<T>& g) {
    finish_g2p(g, a.dx, a.dt, a.position + 3 * p, a.deformation ? a.deformation + 9 * p : nullptr,
               a.position_out + 3 * p, a.velocity_out + 3 * p, a.affine_out + 9 * p,
               a.deformation_out ? a.deformation_out + 9 * p : nullptr);
  }
  static void skip(const GatherArgs<T>& a, int64_t p) {
    skip_g2p(a.dt, a.position + 3 * p, a.velocity ? a.velocity + 3 * p : nullptr,
             a.deformation ? a.deformation + 9 * p : nullptr, a.position_out + 3 * p,
             a.velocity_out + 3 * p, a.affine_out + 9 * p,
             a.deformation_out ? a.deformation_out + 9 * p : nullptr);
  }
};

template <typename T>
struct AdjointGather {
  static constexpr int kChannels = 4;
  static void visit(const GatherArgs<T>& a, int64_t p, const Stencil<T>& s, const Lanes<T>* node,
                    int32_t edge) {
    store(a, p, gather(s, a.dx, node, edge));
  }
  static void store(const GatherArgs<T>& a, int64_t p, const Gathered<T>& g) {
    for (int c = 0; c < 4; ++c) a.value_out[4 * p + c] = g.value[c];
    store_mat3(a.first_out + 9 * p, g.first);
  }
  static void skip(const GatherArgs<T>& a, int64_t p) { store(a, p, Gathered<T>{}); }
};

// d/dx_p of sum w g . (constant + linear d), d = x_i - x_p: what p2g and g2p need for the gradient
// with respect to positions.
template <typename T>
struct SlopeGather {
  static constexpr int kChannels = 4;
  static void visit(const GatherArgs<T>& a, int64_t p, const Stencil<T>& s, const Lanes<T>* node,
                    int32_t edge) {
    const T* c = a.constant + 4 * p;
    const Mat3<T> m = load_mat3(a.linear + 9 * p);
    const Lanes<T> mx{m(0, 0), m(1, 0), m(2, 0), T(0)};
    const Lanes<T> my{m(0, 1), m(1, 1), m(2, 1), T(0)};
    const Lanes<T> mz{m(0, 2), m(1, 2), m(2, 2), T(0)};
    const Lanes<T> constant{c[0], c[1], c[2], c[3]};
    Lanes<T> value{}, along_x{}, along_y{}, along_z{};
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) {
        const T w = s.w[0][i] * s.w[1][j];
        const T wx = s.slope(0, i) * s.w[1][j], wy = s.w[0][i] * s.slope(1, j);
        const Lanes<T> plane = constant + a.dx * ((T(i) - s.f[0]) * mx + (T(j) - s.f[1]) * my);
        const Lanes<T>* n = node + (i * edge + j) * edge;
        for (int k = 0; k < 3; ++k) {
          const Lanes<T> g = n[k] * (plane + (a.dx * (T(k) - s.f[2])) * mz);
          value += (w * s.w[2][k]) * n[k];
          along_x += (wx * s.w[2][k]) * g;
          along_y += (wy * s.w[2][k]) * g;
          along_z += (w * s.slope(2, k)) * g;
        }
      }
    const Lanes<T> along[3] = {along_x, along_y, along_z};
    for (int axis = 0; axis < 3; ++axis) {
      const Lanes<T>& q = along[axis];
      a.slope_out[3 * p + axis] =
          (q[0] + q[1] + q[2] + q[3]) / a.dx -
          (m(0, axis) * value[0] + m(1, axis) * value[1] + m(2, axis) * value[2]);
    }
  }
  static void skip(const GatherArgs<T>& a, int64_t p) {
    for (int axis = 0; axis < 3; ++axis) a.slope_out[3 * p + axis] = T(0);
  }
};

template <typename T, typename Kind>
bool gather_stray(const GatherArgs<T>& a, int64_t p) {
  int32_t field;
  Stencil<T> s;
  StencilBlocks at;
  if (!locate_particle(a, true, p, field, s, at)) return false;
  Lanes<T> tile[27] = {};
  const int64_t base = int64_t(field) * a.blocks.count * kBlockNodes;
  for_each_node([&](int i, int j, int k) {
    const T* node = a.grid + Kind::kChannels * (base + at.node(s, i, j, k));
    for (int c = 0; c < Kind::kChannels; ++c) tile[9 * i + 3 * j + k][c] = node[c];
  });
  Kind::visit(a, p, s, tile, 3);
  return true;
}

template <typename T, typename Kind>
int64_t gather_block(const GatherArgs<T>& a, int64_t block, std::vector<Lanes<T>>& tile) {
  constexpr int kChannels = Kind::kChannels;
  const BlockView& view = a.blocks;
  const OrderRange range(view, block);
  if (range.begin == range.end) return 0;
  const Window window(view, block);
  const NodeRange nodes = view.node_range();
  const T inv_dx = T(1) / a.dx;
  const int32_t edge = window.edge();
  int64_t skipped = 0;
  const uint64_t present = fields_in(view, range, a.body, a.fields);
  for (uint64_t left = present; left != 0; left &= left - 1) {
    const int32_t field = __builtin_ctzll(left);
    const T* grid = a.grid + kChannels * int64_t(field) * view.count * kBlockNodes;
    tile.assign(window.nodes(), Lanes<T>{});
    window.for_each_run([&](int32_t t, int64_t node, int32_t run) {
      const T* in = grid + kChannels * node;
      for (int32_t n = 0; n < run; ++n)
        for (int c = 0; c < kChannels; ++c) tile[t + n][c] = in[kChannels * n + c];
    });
    for (int64_t r = range.begin; r < range.end; ++r) {
      fetch_particle(a, r + kAhead, range.end);
      const int64_t p = view.order[r];
      if (p < 0 || p >= view.particles) continue;
      if (a.body != nullptr && a.body[p] != field) continue;
      Stencil<T> s;
      const bool inside = make_stencil(a.position + 3 * p, inv_dx, nodes, s);
      const int32_t o = inside ? window.offset(s) : -1;
      if (o >= 0) {
        Kind::visit(a, p, s, tile.data() + o, edge);
      } else if (!gather_stray<T, Kind>(a, p)) {
        Kind::skip(a, p);
        ++skipped;
      }
    }
  }
  // Particles whose body is no field, and order entries that are no particle.
  for (int64_t r = range.begin; r < range.end; ++r) {
    const int64_t p = view.order[r];
    const bool real = p >= 0 && p < view.particles;
    const int32_t field = real && a.body != nullptr ? a.body[p] : 0;
    if (real && field >= 0 && field < a.fields) continue;
    if (real) Kind::skip(a, p);
    ++skipped;
  }
  return skipped;
}

template <typename T, typename Kind>
void gather_all(const GatherArgs<T>& a) {
  std::atomic<int64_t> skipped{0};
  parallel_for(a.blocks.count, kBlockGrain, [&](int64_t begin, int64_t end) {
    std::vector<Lanes<T>> tile;
    int64_t mine = 0;
    for (int64_t b = begin; b < end; ++b) mine += gather_block<T, Kind>(a, b, tile);
    skipped += mine;
  });
  *a.skipped += skipped;
}

struct Cpu {
  using Scope = CpuScope;
  template <typename T>
  static void p2g(const P2GArgs<T>& a, const Scope&) {
    cpu::p2g(a);
  }
  template <typename T>
  static void g2p(const GatherArgs<T>& a, const Scope&) {
    gather_all<T, VelocityGather<T>>(a);
  }
  template <typename T>
  static void p2g_adjoint(const GatherArgs<T>& a, const Scope&) {
    gather_all<T, AdjointGather<T>>(a);
  }
  template <typename T>
  static void transfer_slope(const GatherArgs<T>& a, const Scope&) {
    gather_all<T, SlopeGather<T>>(a);
  }
  template <typename T>
  static void grid_update(const GridUpdateArgs<T>& a, const Scope&) {
    cpu::grid_update(a);
  }
};

}  // namespace
}  // namespace cpu
}  // namespace gsf

STABLE_TORCH_LIBRARY_IMPL(gsfluent, CPU, m) {
  gsf::MpmOps<gsf::cpu::Cpu>::register_all(m);
  // CUDA has this one in torch operations: gsfluent/ops/_mpm_grad.py.
  GSF_IMPL_UNBOX(gsf::MpmOps<gsf::cpu::Cpu>, transfer_slope);
}
