// Checks, allocation and dtype dispatch of the deformation ops, once for both back ends.
#pragma once

#include "core/deform/args.h"
#include "torch_api.h"

namespace gsf {

template <class Backend>
struct DeformOps {
  static std::tuple<Tensor, Tensor> polar_clamped(const Tensor& deformation, double lo, double hi) {
    const char* op = "polar_clamped";
    STD_TORCH_CHECK(lo > 0 && hi >= lo, op, ": bounds must satisfy 0 < lo <= hi");
    const Tensor f = ready(op, "deformation", deformation, deformation, {-1, 3, 3});
    const int64_t n = f.size(0);
    Tensor rotation = gsf::new_empty(f, {n, 3, 3}, f.scalar_type());
    Tensor clamped = gsf::new_empty(f, {n, 3, 3}, f.scalar_type());
    const typename Backend::Scope scope(f);
    dispatch_floating(op, f, [&]<typename T>() {
      if (n == 0) return;
      const PolarArgs<T> args{n, cptr<T>(f), T(lo), T(hi), mptr<T>(rotation), mptr<T>(clamped)};
      Backend::polar_clamped(args, scope);
    });
    return {rotation, clamped};
  }

  static std::tuple<Tensor, Tensor> covariance_axes(Tensor covariance) {
    const char* op = "covariance_axes";
    covariance = ready(op, "covariance", covariance, covariance, {-1, 6});
    const int64_t n = covariance.size(0);
    Tensor quats = gsf::new_empty(covariance, {n, 4}, covariance.scalar_type());
    Tensor scales = gsf::new_empty(covariance, {n, 3}, covariance.scalar_type());
    const typename Backend::Scope scope(covariance);
    dispatch_floating(op, covariance, [&]<typename T>() {
      if (n == 0) return;
      Backend::covariance_axes(
          CovarianceAxesArgs<T>{n, cptr<T>(covariance), mptr<T>(quats), mptr<T>(scales)}, scope);
    });
    return {quats, scales};
  }

  static std::tuple<Tensor, Tensor> carry_place(Tensor places, Tensor owner, Tensor near,
                                                Tensor parted, Tensor rest, Tensor position,
                                                Tensor map, Tensor width) {
    const char* op = "carry_place";
    places = ready(op, "places", places, places, {-1, 3});
    rest = ready(op, "rest", rest, places, {-1, 3});
    near = ready(op, "near", near, places, {rest.size(0), -1}, ScalarType::Long);
    const int64_t count = places.size(0), points = rest.size(0), k = near.size(1);
    owner = ready(op, "owner", owner, places, {count}, ScalarType::Long);
    parted = ready(op, "parted", parted, places, {points, k}, ScalarType::Bool);
    position = ready(op, "position", position, places, {points, 3});
    map = ready(op, "map", map, places, {points, 3, 3});
    width = ready(op, "width", width, places, {points});
    Tensor means = gsf::new_empty(places, {count, 3}, places.scalar_type());
    Tensor blend = gsf::new_empty(places, {count, 3, 3}, places.scalar_type());
    const typename Backend::Scope scope(places);
    dispatch_floating(op, places, [&]<typename T>() {
      if (count == 0) return;
      const CarryPlaceArgs<T> args{count,
                                   points,
                                   static_cast<int>(k),
                                   cptr<T>(places),
                                   cptr<int64_t>(owner),
                                   cptr<int64_t>(near),
                                   cptr<bool>(parted),
                                   cptr<T>(rest),
                                   cptr<T>(position),
                                   cptr<T>(map),
                                   cptr<T>(width),
                                   mptr<T>(means),
                                   mptr<T>(blend)};
      Backend::carry_place(args, scope);
    });
    return {means, blend};
  }

  static std::tuple<Tensor, Tensor> carry_axes(Tensor quats, Tensor scales, Tensor map,
                                               Tensor rotation, double rigid) {
    const char* op = "carry_axes";
    quats = ready(op, "quats", quats, quats, {-1, 4});
    const int64_t n = quats.size(0);
    scales = ready(op, "scales", scales, quats, {n, 3});
    map = ready(op, "map", map, quats, {n, 3, 3});
    rotation = ready(op, "rotation", rotation, quats, {n, 3, 3});
    Tensor new_quats = gsf::new_empty(quats, {n, 4}, quats.scalar_type());
    Tensor new_scales = gsf::new_empty(quats, {n, 3}, quats.scalar_type());
    const typename Backend::Scope scope(quats);
    dispatch_floating(op, quats, [&]<typename T>() {
      if (n == 0) return;
      const CarryAxesArgs<T> args{
          n,        cptr<T>(quats),     cptr<T>(scales),    cptr<T>(map), cptr<T>(rotation),
          T(rigid), mptr<T>(new_quats), mptr<T>(new_scales)};
      Backend::carry_axes(args, scope);
    });
    return {new_quats, new_scales};
  }

  static Tensor quats_to_matrices(Tensor quats) {
    quats = ready("quats_to_matrices", "quats", quats, quats, {-1, 4});
    return turned(
        quats, OptTensor(), {quats.size(0), 3, 3},
        [](const auto& args, const auto& scope) { Backend::quats_to_matrices(args, scope); });
  }

  static Tensor matrices_to_quats(Tensor matrices) {
    matrices = ready("matrices_to_quats", "matrices", matrices, matrices, {-1, 3, 3});
    return turned(
        matrices, OptTensor(), {matrices.size(0), 4},
        [](const auto& args, const auto& scope) { Backend::matrices_to_quats(args, scope); });
  }

  static Tensor quat_products(Tensor left, Tensor right) {
    const char* op = "quat_products";
    left = ready(op, "left", left, left, {-1, 4});
    right = ready(op, "right", right, left, {left.size(0), 4});
    return turned(left, right, {left.size(0), 4},
                  [](const auto& args, const auto& scope) { Backend::quat_products(args, scope); });
  }

  static std::tuple<Tensor, Tensor, Tensor> link_states(Tensor position, Tensor apart, Tensor near,
                                                        Tensor piece, OptTensor broken,
                                                        OptTensor parted_before,
                                                        OptTensor opened_before, Tensor none,
                                                        double together, double loose, double open,
                                                        double back) {
    const char* op = "link_states";
    near = ready(op, "near", near, near, {-1, -1}, ScalarType::Long);
    const int64_t points = near.size(0), k = near.size(1), all = position.size(0);
    position = ready(op, "position", position, near, {all, 3}, position.scalar_type());
    STD_TORCH_CHECK(all >= points, op, ": position must have a row for every point");
    apart = ready(op, "apart", apart, position, {points, k});
    piece = ready(op, "piece", piece, position, {all}, ScalarType::Int);
    broken = ready(op, "broken", broken, position, {all}, ScalarType::Bool);
    STD_TORCH_CHECK(parted_before.has_value() == opened_before.has_value(), op,
                    ": parted_before and opened_before come together");
    parted_before =
        ready(op, "parted_before", parted_before, position, {points, k}, ScalarType::Bool);
    opened_before =
        ready(op, "opened_before", opened_before, position, {points, k}, ScalarType::Bool);
    none = ready(op, "none", none, position, {points, k}, ScalarType::Bool);
    Tensor parted = gsf::new_empty(position, {points, k}, ScalarType::Bool);
    Tensor opened = gsf::new_empty(position, {points, k}, ScalarType::Bool);
    Tensor ratio = gsf::new_empty(position, {points, k}, position.scalar_type());
    const typename Backend::Scope scope(position);
    dispatch_floating(op, position, [&]<typename T>() {
      if (points * k == 0) return;
      const LinkStatesArgs<T> args{points * k,
                                   points,
                                   static_cast<int>(k),
                                   cptr<T>(position),
                                   cptr<T>(apart),
                                   cptr<int64_t>(near),
                                   cptr<int32_t>(piece),
                                   cptr<bool>(broken),
                                   cptr<bool>(parted_before),
                                   cptr<bool>(opened_before),
                                   cptr<bool>(none),
                                   T(together),
                                   T(loose),
                                   T(open),
                                   T(back),
                                   mptr<bool>(parted),
                                   mptr<bool>(opened),
                                   mptr<T>(ratio)};
      Backend::link_states(args, scope);
    });
    return {parted, opened, ratio};
  }

  static Tensor find_faces(Tensor rows, Tensor means, Tensor owner, Tensor pitch, Tensor outward,
                           Tensor depth, Tensor near, Tensor opened, Tensor rest,
                           std::vector<double> fit) {
    return faces("find_faces", rows, OptTensor(), means, owner, pitch, outward, depth, near, opened,
                 rest, fit, [](auto& args, const auto& scope, const Tensor& like) {
                   Tensor has =
                       gsf::new_empty(like, {args.count, args.near_count + 1}, ScalarType::Bool);
                   args.has = mptr<bool>(has);
                   if (args.count) Backend::find_faces(args, scope);
                   return has;
                 });
  }

  static std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> face_elements(
      Tensor rows, Tensor column, Tensor means, Tensor owner, Tensor pitch, Tensor outward,
      Tensor depth, Tensor near, Tensor opened, Tensor rest, std::vector<double> fit) {
    return faces("face_elements", rows, column, means, owner, pitch, outward, depth, near, opened,
                 rest, fit,
                 []<typename T>(FaceArgs<T>& args, const auto& scope, const Tensor& like) {
                   const ScalarType kind = like.scalar_type();
                   Tensor rival = gsf::new_empty(like, {args.count}, ScalarType::Long);
                   Tensor centers = gsf::new_empty(like, {args.count, 3}, kind);
                   Tensor quats = gsf::new_empty(like, {args.count, 4}, kind);
                   Tensor scales = gsf::new_empty(like, {args.count, 3}, kind);
                   Tensor normals = gsf::new_empty(like, {args.count, 3}, kind);
                   args.rival = mptr<int64_t>(rival);
                   args.out_means = mptr<T>(centers);
                   args.out_quats = mptr<T>(quats);
                   args.out_scales = mptr<T>(scales);
                   args.out_normals = mptr<T>(normals);
                   if (args.count) Backend::face_elements(args, scope);
                   return std::make_tuple(rival, centers, quats, scales, normals);
                 });
  }

  static std::tuple<Tensor, Tensor, Tensor, Tensor> cut_at_cells(Tensor means, Tensor quats,
                                                                 Tensor scales, Tensor owner,
                                                                 Tensor near, Tensor opened,
                                                                 Tensor rest, double slack) {
    const char* op = "cut_at_cells";
    means = ready(op, "means", means, means, {-1, 3});
    const int64_t count = means.size(0);
    quats = ready(op, "quats", quats, means, {count, 4});
    scales = ready(op, "scales", scales, means, {count, 3});
    rest = ready(op, "rest", rest, means, {-1, 3});
    const int64_t points = rest.size(0);
    owner = ready(op, "owner", owner, means, {count}, ScalarType::Long);
    near = ready(op, "near", near, means, {points, -1}, ScalarType::Long);
    const int64_t k = near.size(1);
    opened = ready(op, "opened", opened, means, {points, k}, ScalarType::Bool);
    Tensor cut = gsf::new_empty(means, {count}, ScalarType::Bool);
    Tensor new_means = gsf::new_empty(means, {count, 3}, means.scalar_type());
    Tensor new_quats = gsf::new_empty(means, {count, 4}, means.scalar_type());
    Tensor new_scales = gsf::new_empty(means, {count, 3}, means.scalar_type());
    const typename Backend::Scope scope(means);
    dispatch_floating(op, means, [&]<typename T>() {
      if (count == 0) return;
      const CutAtCellsArgs<T> args{count,
                                   points,
                                   static_cast<int>(k),
                                   cptr<T>(means),
                                   cptr<T>(quats),
                                   cptr<T>(scales),
                                   cptr<int64_t>(owner),
                                   cptr<int64_t>(near),
                                   cptr<bool>(opened),
                                   cptr<T>(rest),
                                   T(slack),
                                   mptr<bool>(cut),
                                   mptr<T>(new_means),
                                   mptr<T>(new_quats),
                                   mptr<T>(new_scales)};
      Backend::cut_at_cells(args, scope);
    });
    return {cut, new_means, new_quats, new_scales};
  }

  static std::tuple<Tensor, Tensor, Tensor> cut_by_planes(Tensor means, Tensor whole,
                                                          Tensor covariance, Tensor first,
                                                          Tensor normal, Tensor distance,
                                                          Tensor share) {
    const char* op = "cut_by_planes";
    means = ready(op, "means", means, means, {-1, 3});
    const int64_t count = means.size(0);
    whole = ready(op, "whole", whole, means, {count, 3});
    covariance = ready(op, "covariance", covariance, means, {count, 6});
    first = ready(op, "first", first, means, {count + 1}, ScalarType::Long);
    normal = ready(op, "normal", normal, means, {-1, 3});
    const int64_t planes = normal.size(0);
    distance = ready(op, "distance", distance, means, {planes});
    share = ready(op, "share", share, means, {planes});
    Tensor new_means = gsf::new_empty(means, {count, 3}, means.scalar_type());
    Tensor quats = gsf::new_empty(means, {count, 4}, means.scalar_type());
    Tensor scales = gsf::new_empty(means, {count, 3}, means.scalar_type());
    const typename Backend::Scope scope(means);
    dispatch_floating(op, means, [&]<typename T>() {
      if (count == 0) return;
      const CutByPlanesArgs<T> args{count,
                                    planes,
                                    cptr<T>(means),
                                    cptr<T>(whole),
                                    cptr<T>(covariance),
                                    cptr<int64_t>(first),
                                    cptr<T>(normal),
                                    cptr<T>(distance),
                                    cptr<T>(share),
                                    mptr<T>(new_means),
                                    mptr<T>(quats),
                                    mptr<T>(scales)};
      Backend::cut_by_planes(args, scope);
    });
    return {new_means, quats, scales};
  }

  static void register_all(Library& m) {
    GSF_IMPL(DeformOps, polar_clamped);
    GSF_IMPL(DeformOps, covariance_axes);
    GSF_IMPL(DeformOps, carry_place);
    GSF_IMPL(DeformOps, carry_axes);
    GSF_IMPL(DeformOps, quats_to_matrices);
    GSF_IMPL(DeformOps, matrices_to_quats);
    GSF_IMPL(DeformOps, quat_products);
    GSF_IMPL(DeformOps, link_states);
    GSF_IMPL(DeformOps, find_faces);
    GSF_IMPL(DeformOps, face_elements);
    GSF_IMPL(DeformOps, cut_at_cells);
    GSF_IMPL(DeformOps, cut_by_planes);
  }

 private:
  // What both questions about faces are asked with: `ask(args, scope, means)`.
  template <typename Ask>
  static auto faces(const char* op, Tensor rows, OptTensor column, Tensor means, Tensor owner,
                    Tensor pitch, Tensor outward, Tensor depth, Tensor near, Tensor opened,
                    Tensor rest, const std::vector<double>& fit, const Ask& ask) {
    means = ready(op, "means", means, means, {-1, 3});
    const int64_t sites = means.size(0);
    rows = ready(op, "rows", rows, means, {-1}, ScalarType::Long);
    column = ready(op, "column", column, means, {rows.size(0)}, ScalarType::Long);
    owner = ready(op, "owner", owner, means, {sites}, ScalarType::Long);
    pitch = ready(op, "pitch", pitch, means, {sites});
    outward = ready(op, "outward", outward, means, {sites, 3});
    depth = ready(op, "depth", depth, means, {sites});
    rest = ready(op, "rest", rest, means, {-1, 3});
    near = ready(op, "near", near, means, {rest.size(0), -1}, ScalarType::Long);
    opened = ready(op, "opened", opened, means, {rest.size(0), near.size(1)}, ScalarType::Bool);
    STD_TORCH_CHECK(near.size(1) >= 1 && near.size(1) < 4096, op, ": near must have 1 to 4095 ",
                    "columns, got ", near.size(1));
    STD_TORCH_CHECK(fit.size() == kFaceFit, op, ": fit must be ", kFaceFit, " numbers, got ",
                    fit.size());
    const typename Backend::Scope scope(means);
    return dispatch_floating(op, means, [&]<typename T>() {
      FaceArgs<T> args{};
      args.count = rows.size(0);
      args.sites = sites;
      args.points = rest.size(0);
      args.near_count = static_cast<int>(near.size(1));
      args.fit = {T(fit[0]), T(fit[1]), T(fit[2]), T(fit[3]), T(fit[4]),
                  T(fit[5]), T(fit[6]), T(fit[7]), T(fit[8])};
      args.rows = cptr<int64_t>(rows);
      args.column = cptr<int64_t>(column);
      args.means = cptr<T>(means);
      args.owner = cptr<int64_t>(owner);
      args.pitch = cptr<T>(pitch);
      args.outward = cptr<T>(outward);
      args.depth = cptr<T>(depth);
      args.near = cptr<int64_t>(near);
      args.opened = cptr<bool>(opened);
      args.rest = cptr<T>(rest);
      return ask(args, scope, means);
    });
  }

  // One of the ops of turn.h: `run(args, scope)`.
  template <typename Run>
  static Tensor turned(const Tensor& first, const OptTensor& second,
                       const std::vector<int64_t>& shape, const Run& run) {
    Tensor out = gsf::new_empty(first, shape, first.scalar_type());
    const typename Backend::Scope scope(first);
    dispatch_floating("turns", first, [&]<typename T>() {
      if (shape[0] == 0) return;
      run(TurnArgs<T>{shape[0], cptr<T>(first), cptr<T>(second), mptr<T>(out)}, scope);
    });
    return out;
  }
};

}  // namespace gsf
