// Eight (or, in double, four) particles of one home at a time, one per lane: their stencils, what
// they give to the nodes and gather from them.
#pragma once

#include "core/solver/particle.h"
#include "cpu/mpm/lanes.h"
#include "cpu/pack.h"

namespace gsf::cpu {

// Node of the window at the base of a particle's stencil.
inline int window_node(uint32_t meta) {
  int at = 0;
  for (int axis = 0; axis < 3; ++axis) {
    const int l = meta_cell(meta, axis);
    at = at * kWindowEdge + (l < kLastCell ? l : kLastCell);
  }
  return at;
}

// Particles of a packet; unused lanes repeat the last one.
template <typename T>
struct Packet {
  static constexpr int kLanes = Pack<T>::kLanes;
  static constexpr uint32_t kAll = (1u << kLanes) - 1u;

  int32_t index[kLanes];
  uint32_t meta[kLanes];
  uint32_t active;   // bit per lane
  bool consecutive;  // particles index[0], index[0] + 1, ...
  bool inner;        // without the last particle of all: four values of a row of three may be read

  Packet(const SolverView<T>& s, const int32_t* order, int64_t count) {
    const int used = count < kLanes ? static_cast<int>(count) : kLanes;
    active = (1u << used) - 1u;
    int32_t furthest = 0;
    for (int lane = 0; lane < kLanes; ++lane) {
      index[lane] = order[lane < used ? lane : used - 1];
      furthest = std::max(furthest, index[lane]);
      meta[lane] = s.meta[index[lane]];
    }
    inner = furthest + 1 < s.count;
    consecutive = true;
    for (int lane = 1; lane < kLanes; ++lane)
      consecutive = consecutive && index[lane] == index[0] + lane;
  }

  // Mask of the lanes that hold a particle of their own.
  typename Pack<T>::Int used_lanes() const {
    const typename Pack<T>::Int bits = int_pack_of<T>([](int lane) { return 1 << lane; });
    return (bits & static_cast<int>(active)) != 0;
  }
  // Lanes [first, end) whose particles share the cell of lane `first`.
  int run(int first) const {
    int end = first + 1;
    while (end < kLanes && (meta[end] & 511u) == (meta[first] & 511u)) ++end;
    return end;
  }
  bool same_rows() const {
    bool same = true;
    for (int lane = 1; lane < kLanes; ++lane)
      same = same && meta_row(meta[lane]) == meta_row(meta[0]);
    return same;
  }

  // Columns of an array with one row per particle.
  [[gnu::always_inline]] void load3(const T* array, Pack<T>* out) const {
    Quad<T> rows[kLanes];
    const auto row = [&](int lane) { return array + 3 * int64_t(index[lane]); };
    if (inner)
      for (int lane = 0; lane < kLanes; ++lane) rows[lane] = load_quad(row(lane));
    else
      for (int lane = 0; lane < kLanes; ++lane)
        rows[lane] = Quad<T>{row(lane)[0], row(lane)[1], row(lane)[2], T(0)};
    Pack<T> four[4];
    transpose(rows, four);
    for (int c = 0; c < 3; ++c) out[c] = four[c];
  }
  [[gnu::always_inline]] void load4(const T* array, int width, int first, Pack<T>* out) const {
    Quad<T> rows[kLanes];
    for (int lane = 0; lane < kLanes; ++lane)
      rows[lane] = load_quad(array + width * int64_t(index[lane]) + first);
    transpose(rows, out);
  }
  [[gnu::always_inline]] Pack<T> load1(const T* array, int width = 1, int column = 0) const {
    if (width == 1 && consecutive) return load_pack(array + index[0]);
    return pack_of<T>([&](int lane) { return array[width * int64_t(index[lane]) + column]; });
  }
  [[gnu::always_inline]] void load9(const T* array, Pack<T>* out) const {
    load4(array, 9, 0, out);
    load4(array, 9, 4, out + 4);
    out[8] = load1(array, 9, 8);
  }
  [[gnu::always_inline]] Sym3<Pack<T>> load6(const T* array) const {
    Pack<T> a[4], b[4];
    load4(array, 6, 0, a);
    load4(array, 6, 2, b);
    return {a[0], a[1], a[2], a[3], b[2], b[3]};
  }

  // Columns of the rows of their materials.
  [[gnu::always_inline]] void load_rows(const SolverView<T>& s, Pack<T>* out) const {
    static_assert(kRowColumns == 12);
    Quad<T> rows[kLanes];
    for (int first = 0; first < kRowColumns; first += 4) {
      for (int lane = 0; lane < kLanes; ++lane)
        rows[lane] = load_quad(s.rows + int64_t(s.row_of(meta[lane])) * kRowColumns + first);
      transpose(rows, out + first);
    }
  }

  // The same the other way, for the lanes in `lanes`.
  template <int kBytes>
  [[gnu::always_inline]] void store_rows(const Quad<T>* rows, T* array, int width, int first,
                                         uint32_t lanes) const {
    const auto put = [&](int lane) {
      std::memcpy(array + width * int64_t(index[lane]) + first, rows + lane, kBytes);
    };
    if (lanes == kAll)
      for (int lane = 0; lane < kLanes; ++lane) put(lane);
    else
      for (; lanes != 0; lanes &= lanes - 1) put(__builtin_ctz(lanes));
  }
  [[gnu::always_inline]] void store3(const Pack<T>* values, T* array, uint32_t lanes) const {
    const Pack<T> four[4] = {values[0], values[1], values[2], values[2]};
    Quad<T> rows[kLanes];
    transpose(four, rows);
    store_rows<3 * sizeof(T)>(rows, array, 3, 0, lanes);
  }
  [[gnu::always_inline]] void store4(const Pack<T>* values, T* array, int width, int first,
                                     uint32_t lanes) const {
    Quad<T> rows[kLanes];
    transpose(values, rows);
    store_rows<4 * sizeof(T)>(rows, array, width, first, lanes);
  }
  [[gnu::always_inline]] void store6(const Sym3<Pack<T>>& e, T* array, uint32_t lanes) const {
    const Pack<T> a[4] = {e.xx, e.yy, e.zz, e.xy}, b[4] = {e.zz, e.xy, e.xz, e.yz};
    store4(a, array, 6, 0, lanes);
    store4(b, array, 6, 2, lanes);
  }
  [[gnu::always_inline]] void store9(const Pack<T>* values, T* array, uint32_t lanes) const {
    store4(values, array, 9, 0, lanes);
    store4(values + 4, array, 9, 4, lanes);
    for (; lanes != 0; lanes &= lanes - 1) {
      const int lane = __builtin_ctz(lanes);
      array[9 * int64_t(index[lane]) + 8] = values[8][lane];
    }
  }
};

// What the lanes of a packet give to nodes, laid out for one lane at a time.
template <typename T>
struct PacketMomentum {
  static constexpr int kLanes = Pack<T>::kLanes;
  Pack<T> weight[27];
  // Momentum and mass at the nodes: (start[i] + j y + k z) of lane l.
  Quad<T> start[3][kLanes], y[kLanes], z[kLanes];

  Quad<T> moment[kLanes];  // m f, m

  PacketMomentum(const SolverView<T>& s, const Packet<T>& p) {
    Pack<T> offset[3], velocity[3];
    Mat3<Pack<T>> slope;
    p.load3(s.offset, offset);
    p.load3(s.velocity, velocity);
    p.load9(s.slope, slope.m);
    const Stencil<Pack<T>> stencil = stencil_at(offset);
    const auto row = [&](int lane) {
      return s.rows + int64_t(s.row_of(p.meta[lane])) * kRowColumns;
    };
    const Pack<T> mass = p.same_rows()
                             ? Pack<T>(row(0)[kMassColumn])
                             : pack_of<T>([&](int lane) { return row(lane)[kMassColumn]; });
    for (int i = 0; i < 9; ++i) slope.m[i] *= Pack<T>(s.dx);
    Pack<T> a[4], b[4];
    for (int c = 0; c < 3; ++c)
      a[c] = mass * velocity[c] -
             (slope(c, 0) * stencil.f[0] + slope(c, 1) * stencil.f[1] + slope(c, 2) * stencil.f[2]);
    a[3] = mass;
    transpose(a, start[0]);
    for (int i = 1; i < 3; ++i) {
      for (int c = 0; c < 3; ++c) a[c] += slope(c, 0);
      transpose(a, start[i]);
    }
    b[3] = Pack<T>(0);
    for (int c = 0; c < 3; ++c) b[c] = slope(c, 1);
    transpose(b, y);
    for (int c = 0; c < 3; ++c) b[c] = slope(c, 2);
    transpose(b, z);
    if (s.moments != nullptr) {
      for (int c = 0; c < 3; ++c) b[c] = mass * stencil.f[c];
      b[3] = mass;
      transpose(b, moment);
    }
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) {
        const Pack<T> w = stencil.w[0][i] * stencil.w[1][j];
        for (int k = 0; k < 3; ++k) weight[9 * i + 3 * j + k] = w * stencil.w[2][k];
      }
  }

  // Adds lanes [first, end), all of one cell, to the tile at the base of their stencil; in single
  // precision two lanes at once. The tile is double: a node's sum has a term per cell, whose
  // roundings would be most of what a step adds to the momentum.
  void scatter(int first, int end, Lanes<double>* node) const {
    for (int i = 0; i < 3; ++i, node += kWindowEdge * kWindowEdge) {
      const Pack<T>* w = weight + 9 * i;
      Raw sum[9] = {};
      int lane = first;
      if constexpr (sizeof(T) == 4) {
        for (; lane + 1 < end; lane += 2)
          add_plane(w, sum, load_pack(reinterpret_cast<const T*>(start[i] + lane)).v,
                    load_pack(reinterpret_cast<const T*>(y + lane)).v,
                    load_pack(reinterpret_cast<const T*>(z + lane)).v,
                    [&](const Pack<T>& weights) { return two_lanes(weights, lane); });
      }
      for (; lane < end; ++lane)
        add_plane(w, sum, one_lane(start[i][lane]), one_lane(y[lane]), one_lane(z[lane]),
                  [&](const Pack<T>& weights) { return Pack<T>(weights[lane]).v; });
      for (int n = 0; n < 9; ++n) node[n / 3 * kWindowEdge + n % 3] += doubles(both_lanes(sum[n]));
    }
  }

  // The same for the first moment of the mass about each node, in cells (core/mpm/contact.h).
  void scatter_moment(int first, int end, Lanes<T>* node) const {
    for (int i = 0; i < 3; ++i, node += kWindowEdge * kWindowEdge) {
      const Pack<T>* w = weight + 9 * i;
      Raw sum[9] = {};
      int lane = first;
      if constexpr (sizeof(T) == 4) {
        for (; lane + 1 < end; lane += 2) {
          const Raw two = load_pack(reinterpret_cast<const T*>(moment + lane)).v;
          for (int n = 0; n < 9; ++n) sum[n] += two_lanes(w[n], lane) * two;
        }
      }
      for (; lane < end; ++lane) {
        const Raw one = one_lane(moment[lane]);
        for (int n = 0; n < 9; ++n) sum[n] += Pack<T>(w[n][lane]).v * one;
      }
      for (int n = 0; n < 9; ++n) {
        const Lanes<T> all = both_lanes(sum[n]);
        node[n / 3 * kWindowEdge + n % 3] +=
            all - all[3] * Lanes<T>{T(i), T(n / 3), T(n % 3), T(0)};
      }
    }
  }

  // Adds an impulse to what lane `lane` gives.
  void push(int lane, const T* impulse) {
    const Quad<T> given{impulse[0], impulse[1], impulse[2], T(0)};
    for (auto& at : start) at[lane] += given;
  }

  // Adds four numbers of each of the lanes [first, end) by weight alone.
  void scatter_four(int first, int end, const T* values, Lanes<T>* node) const {
    for (int n = 0; n < 27; ++n) {
      Lanes<T> sum{};
      for (int lane = first; lane < end; ++lane)
        sum += weight[n][lane] * Lanes<T>{values[4 * lane], values[4 * lane + 1],
                                          values[4 * lane + 2], values[4 * lane + 3]};
      node[(n / 9 * kWindowEdge + n / 3 % 3) * kWindowEdge + n % 3] += sum;
    }
  }

  using Raw = typename Pack<T>::Raw;

  // Nine nodes of one plane of the stencil: momentum q + j y + k z.
  template <typename Weight>
  [[gnu::always_inline]] static void add_plane(const Pack<T>* w, Raw* sum, Raw q, Raw y, Raw z,
                                               const Weight& weight_of) {
    for (int j = 0; j < 3; ++j, q += y) {
      const Raw middle = q + z;
      sum[3 * j] += weight_of(w[3 * j]) * q;
      sum[3 * j + 1] += weight_of(w[3 * j + 1]) * middle;
      sum[3 * j + 2] += weight_of(w[3 * j + 2]) * (middle + z);
    }
  }
  // Weights of this lane and the next, each over half a register.
  static Raw two_lanes(const Pack<T>& weights, int lane) {
    double two;
    std::memcpy(&two, reinterpret_cast<const T*>(&weights) + lane, sizeof two);
    const Raw pairs = reinterpret_cast<Raw>(Pack<double>(two).v);
    return __builtin_shufflevector(pairs, pairs, 0, 0, 0, 0, 5, 5, 5, 5);
  }
  static Raw one_lane(Quad<T> q) {
    if constexpr (sizeof(T) == 4)
      return __builtin_shufflevector(q, Quad<T>{}, 0, 1, 2, 3, 4, 5, 6, 7);
    else
      return q;
  }
  // gcc takes the conversion apart, through memory.
  static Lanes<double> doubles(Lanes<T> x) {
#ifdef __AVX__
    if constexpr (sizeof(T) == 4) return __builtin_ia32_cvtps2pd256(x);
#endif
    return __builtin_convertvector(x, Lanes<double>);
  }
  static Lanes<T> both_lanes(Raw sum) {
    if constexpr (sizeof(T) == 4)
      return __builtin_shufflevector(sum, sum, 0, 1, 2, 3) +
             __builtin_shufflevector(sum, sum, 4, 5, 6, 7);
    else
      return sum;
  }
};

// What one packet of particles gathers: value = sum w v, first = sum w v (node - f) in cells.
template <typename T>
struct PacketGathered {
  Pack<T> value[3];
  Mat3<Pack<T>> first;
};

// Gathers for lanes that share the cell whose stencil begins at `node`.
template <typename T>
PacketGathered<T> packet_gather(const Pack<T>* offset, const Lanes<T>* node) {
  using P = Pack<T>;
  const T* first = reinterpret_cast<const T*>(node);
  const auto at = [&](int c, int i, int j, int k) {
    return P(first[4 * ((i * kWindowEdge + j) * kWindowEdge + k) + c]);
  };
  const auto row = [](const P& middle, const P& w0, const P& below, const P& w2, const P& above) {
    return middle + (w0 * below + w2 * above);
  };
  PacketGathered<T> g;
  gather_stencil(stencil_at(offset), at, row, g.value, g.first);
  return g;
}

}  // namespace gsf::cpu
