// CPU kernels of the deformation ops.
#include "host/deform.h"

#include <algorithm>

#include "core/deform/carry.h"
#include "core/deform/cut.h"
#include "core/deform/faces.h"
#include "core/deform/link.h"
#include "core/deform/turn.h"
#include "cpu/svd.h"

namespace gsf {
namespace {

// Rows [begin, end) of an [N, 9] array as packets of matrices: f(first row, rows in use, matrices).
// What a row gives does not depend on its place: lanes past the end repeat the last row.
template <typename T, typename F>
void for_each_packet(const T* rows, int64_t begin, int64_t end, const F& f) {
  constexpr int kLanes = cpu::Pack<T>::kLanes;
  for (int64_t first = begin; first < end; first += kLanes) {
    const int used = static_cast<int>(std::min<int64_t>(end - first, kLanes));
    Mat3<cpu::Pack<T>> m;
    for (int k = 0; k < 9; ++k)
      m.m[k] = cpu::pack_of<T>(
          [&](int lane) { return rows[9 * (first + std::min(lane, used - 1)) + k]; });
    f(first, used, m);
  }
}

template <typename T>
Mat3<T> of_lane(const Mat3<cpu::Pack<T>>& m, int lane) {
  Mat3<T> r;
  for (int k = 0; k < 9; ++k) r.m[k] = m.m[k][lane];
  return r;
}

// ellipsoid_axes (core/deform/carry.h) of some rows: maps [N, 9] to quats [N, 4], scales [N, 3].
template <typename T>
void ellipsoid_axes_of(const T* maps, int64_t count, T share, T* quats, T* scales) {
  for_each_packet(maps, 0, count, [&](int64_t first, int used, const Mat3<cpu::Pack<T>>& map) {
    typename cpu::Pack<T>::Int plain = typename cpu::Pack<T>::Int{} - 1;
    const Svd3<cpu::Pack<T>> d = cpu::svd3<T>(map, plain);
    for (int lane = 0; lane < used; ++lane) {
      const int64_t i = first + lane;
      if (plain[lane] == 0) {
        ellipsoid_axes(load_mat3(maps + 9 * i), share, quats + 4 * i, scales + 3 * i);
        continue;
      }
      quat_from_rotation(of_lane<T>(d.u, lane), quats + 4 * i);
      const T least = share * std::abs(d.sigma.x[lane]);
      for (int k = 0; k < 3; ++k) scales[3 * i + k] = max(std::abs(d.sigma[k][lane]), least);
    }
  });
}

struct DeformCpu {
  using Scope = CpuScope;
  template <typename T>
  static void polar_clamped(const PolarArgs<T>& a, const Scope&) {
    using P = cpu::Pack<T>;
    parallel_for(a.count, 256, [&](int64_t begin, int64_t end) {
      for_each_packet(a.deformation, begin, end, [&](int64_t first, int used, const Mat3<P>& f) {
        typename P::Int plain = typename P::Int{} - 1;
        const Svd3<P> d = cpu::svd3<T>(f, plain);
        const P lo(a.lo), hi(a.hi);
        const Vec3<P> s = {clamp(d.sigma.x, lo, hi), clamp(d.sigma.y, lo, hi),
                           clamp(d.sigma.z, lo, hi)};
        const Mat3<P> rotation = compose_svd(d.u, Vec3<P>{P(1), P(1), P(1)}, d.v);
        const Mat3<P> clamped = compose_svd(d.u, s, d.v);
        for (int lane = 0; lane < used; ++lane) {
          Mat3<T> turn = of_lane<T>(rotation, lane), shape = of_lane<T>(clamped, lane);
          if (plain[lane] == 0) gsf::polar_clamped(of_lane<T>(f, lane), a.lo, a.hi, turn, shape);
          store_mat3(a.rotation + 9 * (first + lane), turn);
          store_mat3(a.clamped + 9 * (first + lane), shape);
        }
      });
    });
  }
  template <typename T>
  static void covariance_axes(const CovarianceAxesArgs<T>& a, const Scope&) {
    parallel_for(a.count, 256, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) gsf::covariance_axes(a, i);
    });
  }
  template <typename T>
  static void carry_place(const CarryPlaceArgs<T>& a, const Scope&) {
    parallel_for(a.count, 256, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) gsf::carry_place(a, i);
    });
  }
  template <typename T>
  static void quats_to_matrices(const TurnArgs<T>& a, const Scope&) {
    parallel_for(a.count, 4096, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) gsf::quats_to_matrices(a, i);
    });
  }
  template <typename T>
  static void matrices_to_quats(const TurnArgs<T>& a, const Scope&) {
    parallel_for(a.count, 4096, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) gsf::matrices_to_quats(a, i);
    });
  }
  template <typename T>
  static void quat_products(const TurnArgs<T>& a, const Scope&) {
    parallel_for(a.count, 4096, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) gsf::quat_products(a, i);
    });
  }
  template <typename T>
  static void link_states(const LinkStatesArgs<T>& a, const Scope&) {
    parallel_for(a.count, 4096, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) gsf::link_states(a, i);
    });
  }
  template <typename T>
  static void find_faces(const FaceArgs<T>& a, const Scope&) {
    parallel_for(a.count, 256, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i)
        for (int k = 0; k <= a.near_count; ++k)
          a.has[i * (a.near_count + 1) + k] = has_face(a, i, k);
    });
  }
  template <typename T>
  static void face_elements(const FaceArgs<T>& a, const Scope&) {
    parallel_for(a.count, 256, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) face_element(a, i);
    });
  }
  template <typename T>
  static void cut_at_cells(const CutAtCellsArgs<T>& a, const Scope&) {
    parallel_for(a.count, 256, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) gsf::cut_at_cells(a, i);
    });
  }
  template <typename T>
  static void cut_by_planes(const CutByPlanesArgs<T>& a, const Scope&) {
    parallel_for(a.count, 256, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) gsf::cut_by_planes(a, i);
    });
  }
  template <typename T>
  static void carry_axes(const CarryAxesArgs<T>& a, const Scope&) {
    constexpr int64_t kChunk = 64;
    parallel_for(a.count, 256, [&](int64_t begin, int64_t end) {
      // Those that are stretched wait until there are enough of them for packets.
      T maps[9 * kChunk], quats[4 * kChunk], scales[3 * kChunk];
      int64_t row[kChunk], waiting = 0;
      const auto give = [&] {
        ellipsoid_axes_of(maps, waiting, T(kLeastAxis), quats, scales);
        for (int64_t n = 0; n < waiting; ++n) {
          std::copy_n(quats + 4 * n, 4, a.quats + 4 * row[n]);
          std::copy_n(scales + 3 * n, 3, a.scales + 3 * row[n]);
        }
        waiting = 0;
      };
      for (int64_t i = begin; i < end; ++i) {
        gsf::carry_axes(a, i, [&](const Mat3<T>& root) {
          store_mat3(maps + 9 * waiting, root);
          row[waiting++] = i;
        });
        if (waiting == kChunk) give();
      }
      give();
    });
  }
};

}  // namespace
}  // namespace gsf

GSF_REGISTER(CPU, gsf::DeformOps<gsf::DeformCpu>)
