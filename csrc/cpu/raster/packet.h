// Eight Gaussians (four in double) of one camera at once, one per lane: the projection of
// core/raster/splat.h and what the CPU keeps of a splat.
#pragma once

#include "cpu/pack.h"
#include "cpu/raster/row.h"

namespace gsf::raster_cpu {

template <typename T>
inline constexpr int kPacket = cpu::Pack<T>::kLanes;

template <typename T>
SplatCamera<cpu::Pack<T>> packed(const SplatCamera<T>& c) {
  using P = cpu::Pack<T>;
  const auto vec = [](const Vec3<T>& v) { return Vec3<P>{P(v.x), P(v.y), P(v.z)}; };
  SplatCamera<P> p;
  for (int k = 0; k < 9; ++k) p.rotation.m[k] = P(c.rotation.m[k]);
  p.translation = vec(c.translation);
  p.centre = vec(c.centre);
  p.fx = P(c.fx), p.fy = P(c.fy), p.cx = P(c.cx), p.cy = P(c.cy);
  p.low_u = P(c.low_u), p.high_u = P(c.high_u), p.low_v = P(c.low_v), p.high_v = P(c.high_v);
  p.near = P(c.near), p.far = P(c.far);
  p.width = c.width;
  p.height = c.height;
  return p;
}

// The Gaussians [first, first + used) of `count`; lanes beyond repeat the last one.
template <typename T>
struct PacketRows {
  int64_t first, count;
  int used;

  int64_t row(int lane) const { return first + std::min(lane, used - 1); }

  // Columns of an array [count, kWidth], kWidth of 1 to 4.
  template <int kWidth>
  void columns(const T* rows, cpu::Pack<T>* out) const {
    // A quad of a row reaches into the next one, but not beyond the array.
    if (used == kPacket<T> && (first + used) * kWidth + 4 - kWidth <= count * kWidth) {
      cpu::Quad<T> quad[kPacket<T>];
      for (int lane = 0; lane < kPacket<T>; ++lane)
        quad[lane] = cpu::load_quad(rows + (first + lane) * kWidth);
      cpu::Pack<T> four[4];
      cpu::transpose(quad, four);
      std::copy_n(four, kWidth, out);
    } else {
      for (int k = 0; k < kWidth; ++k)
        out[k] = cpu::pack_of<T>([&](int lane) { return rows[row(lane) * kWidth + k]; });
    }
  }
  cpu::Pack<T> column(const T* values) const {
    return cpu::pack_of<T>([&](int lane) { return values[row(lane)]; });
  }
};

// Projects a packet as the splats from `splat` on: rows of `splats`, boxes, depths and radii.
// Returns the number of tiles.
template <typename T>
int64_t project_packet(const RasterArgs<T>& a, const SplatCamera<cpu::Pack<T>>& cam,
                       const PacketRows<T>& rows, int64_t splat, TileBox* boxes, T* depths) {
  using P = cpu::Pack<T>;
  constexpr int kLanes = kPacket<T>;
  P mean[3];
  rows.template columns<3>(a.means, mean);
  const Vec3<P> point{mean[0], mean[1], mean[2]};
  SplatFrame<P> frame;
  auto seen = splat_frame_point(cam, point, &frame);
  if (a.covars) {
    P c[6];
    for (int k = 0; k < 6; ++k)
      c[k] = cpu::pack_of<T>([&](int lane) { return a.covars[6 * rows.row(lane) + k]; });
    splat_frame_covariance(Sym3<P>{c[0], c[1], c[2], c[3], c[4], c[5]}, &frame);
  } else {
    P quat[4], scales[3];
    rows.template columns<4>(a.quats, quat);
    rows.template columns<3>(a.scales, scales);
    Mat3<P> axes;
    seen &= rotation_from_quat(quat, &axes);
    splat_frame_axes(axes, scales, &frame);
  }
  const auto moved = [&](int axis) {
    if (!a.offset) return P(0);
    return cpu::pack_of<T>(
        [&](int lane) { return a.offset[2 * (splat + std::min(lane, rows.used - 1)) + axis]; });
  };
  Splat<P> s;
  seen &= splat_finish(cam, frame, rows.column(a.opacities), a.antialiased, moved(0), moved(1), &s);
  // splat_box of core/raster/splat.h.
  const P half(0.5), wide(a.width), high(a.height), none(0);
  typename P::Int whole;
  const auto first = [&](P x, P most) { return clamp(-cpu::floor(half - x, whole), none, most); };
  const auto last = [&](P x, P most) {
    return clamp(cpu::floor(x - half, whole) + P(1), none, most);
  };
  const P x0 = first(s.x - s.extent_x, wide), x1 = last(s.x + s.extent_x, wide);
  const P y0 = first(s.y - s.extent_y, high), y1 = last(s.y + s.extent_y, high);
  seen &= (x0 < x1) & (y0 < y1);

  const SplatConic<P> conic = SplatConic<P>::of(s);
  const P level = cpu::pack_of<T>([&](int lane) { return std::log2(s.opacity[lane]); });
  const P head[2][4] = {{s.x, s.y, conic.across, P(1) / conic.across},
                        {conic.slope, conic.down, level, P(kLog2E) * s.cutoff}};
  cpu::Quad<T> quads[2][kLanes];
  for (int k = 0; k < 2; ++k) cpu::transpose(head[k], quads[k]);
  Vec3<P> direction;
  P length;
  if (a.sh) direction = view_direction(cam, point, &length);
  const P reach = max(s.extent_x, s.extent_y);
  const uint32_t visible = cpu::mask_bits(seen);
  int64_t tiles = 0;
  for (int lane = 0; lane < rows.used; ++lane) {
    const int64_t at = splat + lane, i = rows.first + lane;
    T* row = a.splats + at * a.stride;
    const T* sh = a.sh ? a.sh + 3 * sh_coefficients(a.sh_degree) * i : nullptr;
    Vec3<T> toward{};
    if (sh) toward = {direction.x[lane], direction.y[lane], direction.z[lane]};
    if (!(visible >> lane & 1) ||
        !splat_features(a, toward, i, a.sh_degree, sh, s.depth[lane], row + kFeatures)) {
      std::fill_n(row, a.stride, T(0));
      boxes[at] = {0, 0, 0, 0};
      depths[at] = T(0);
      a.radii[at] = 0;
      continue;
    }
    std::memcpy(row, &quads[0][lane], 4 * sizeof(T));
    std::memcpy(row + 4, &quads[1][lane], 4 * sizeof(T));
    std::fill(row + kFeatures + a.features, row + a.stride, T(0));
    const auto edge = [&](const P& p) { return static_cast<int>(p[lane]); };
    const PixelBox box = tile_box({edge(x0), edge(y0), edge(x1), edge(y1)}, kTileEdge);
    boxes[at] = {static_cast<uint16_t>(box.x0), static_cast<uint16_t>(box.y0),
                 static_cast<uint16_t>(box.x1), static_cast<uint16_t>(box.y1)};
    std::memcpy(row + kBox, &boxes[at], sizeof(TileBox));
    depths[at] = s.depth[lane];
    a.radii[at] = static_cast<int32_t>(std::ceil(gsf::min(reach[lane], T(1 << 24))));
    tiles += boxes[at].count();
  }
  return tiles;
}

}  // namespace gsf::raster_cpu
