// Checks and allocation of the spatial ops, once for both back ends.
#pragma once

#include <limits>

#include "core/distance.h"
#include "core/labels.h"
#include "core/nearest.h"
#include "core/spatial.h"
#include "torch_api.h"

namespace gsf {

template <class Backend>
struct SpatialOps {
  static Tensor nearest_labels(Tensor place, Tensor rank, std::vector<int64_t> shape,
                               double radius) {
    const char* op = "nearest_labels";
    place = ready(op, "place", place, place, {-1, 3}, ScalarType::Double);
    rank = ready(op, "rank", rank, place, {place.size(0)}, ScalarType::Long);
    check_grid(op, shape);
    STD_TORCH_CHECK(radius >= 0 && radius <= 1000, op, ": radius must be 0 to 1000, got ", radius);
    Tensor labels = gsf::new_empty(place, shape, ScalarType::Short);
    Tensor best = gsf::new_empty(place, shape, ScalarType::Long);
    const NearestLabelsArgs args{place.size(0),
                                 cptr<double>(place),
                                 cptr<int64_t>(rank),
                                 {shape[0], shape[1], shape[2]},
                                 static_cast<int64_t>(std::rint(radius * radius * kFineSquares)),
                                 static_cast<int>(std::ceil(radius)),
                                 mptr<int64_t>(best),
                                 mptr<int16_t>(labels)};
    const typename Backend::Scope scope(place);
    Backend::nearest_labels(args, scope);
    return labels;
  }

  static std::tuple<Tensor, Tensor, Tensor> largest_shares(OptTensor place,
                                                           std::vector<int64_t> shape,
                                                           Tensor shares, Tensor box) {
    const char* op = "largest_shares";
    shares = ready(op, "shares", shares, shares, {-1}, ScalarType::Float);
    box = ready(op, "box", box, shares, {-1, 7}, ScalarType::Long);
    place = ready(op, "place", place, shares, {-1, 3}, ScalarType::Float);
    STD_TORCH_CHECK(box.size(0) <= 32767, op, ": at most 32767 fields, got ", box.size(0));
    check_grid(op, shape);
    const std::vector<int64_t> sizes = place ? std::vector<int64_t>{place->size(0)} : shape;
    Tensor first = gsf::new_empty(shares, sizes, ScalarType::Short);
    Tensor second = gsf::new_empty(shares, sizes, ScalarType::Short);
    Tensor lead = gsf::new_empty(shares, sizes, ScalarType::Float);
    int64_t count = 1;
    for (const int64_t n : sizes) count *= n;
    const LargestSharesArgs args{count,
                                 cptr<float>(place),
                                 {shape[0], shape[1], shape[2]},
                                 box.size(0),
                                 cptr<float>(shares),
                                 cptr<int64_t>(box),
                                 shares.size(0),
                                 mptr<int16_t>(first),
                                 mptr<int16_t>(second),
                                 mptr<float>(lead)};
    const typename Backend::Scope scope(shares);
    Backend::largest_shares(args, scope);
    return {first, second, lead};
  }

  static std::tuple<Tensor, Tensor> nearest_points(Tensor points, Tensor queries, OptTensor group,
                                                   OptTensor asked, double cell, double reach,
                                                   int64_t count) {
    const char* op = "nearest_points";
    points = ready(op, "points", points, points, {-1, 3}, ScalarType::Double);
    queries = ready(op, "queries", queries, points, {-1, 3}, ScalarType::Double);
    group = ready(op, "group", group, points, {points.size(0)}, ScalarType::Long);
    asked = ready(op, "asked", asked, points, {queries.size(0)}, ScalarType::Long);
    STD_TORCH_CHECK(bool(group) == bool(asked), op, ": group and asked go together");
    STD_TORCH_CHECK(cell > 0 && std::isfinite(cell), op, ": cell must be positive, got ", cell);
    STD_TORCH_CHECK(reach >= 0, op, ": reach must not be negative, got ", reach);
    STD_TORCH_CHECK(count >= 1, op, ": count must be at least 1, got ", count);
    // 32 of the largest buckets are counted in 32 bits
    STD_TORCH_CHECK(points.size(0) < (int64_t(1) << 27), op, ": fewer than 2^27 points, got ",
                    points.size(0));
    int64_t buckets = 32;
    while (buckets < 2 * points.size(0)) buckets *= 2;
    const auto made = [&](std::vector<int64_t> sizes, ScalarType kind) {
      return gsf::new_empty(points, sizes, kind);
    };
    Tensor box = made({6}, ScalarType::Long), marks = made({2, kNearestLevels}, ScalarType::Long);
    Tensor table = made({2, buckets}, ScalarType::Int),
           row = made({points.size(0)}, ScalarType::Int);
    Tensor done = made({queries.size(0)}, ScalarType::Byte);
    Tensor distance = made({queries.size(0), count}, ScalarType::Double);
    Tensor index = made({queries.size(0), count}, ScalarType::Long);
    auto* left = reinterpret_cast<unsigned long long*>(mptr<int64_t>(marks));
    const NearestArgs args{points.size(0),
                           queries.size(0),
                           count,
                           buckets,
                           cptr<double>(points),
                           cptr<double>(queries),
                           cptr<int64_t>(group),
                           cptr<int64_t>(asked),
                           cell,
                           reach,
                           mptr<int64_t>(box),
                           mptr<int32_t>(table),
                           mptr<int32_t>(table) + buckets,
                           mptr<int32_t>(row),
                           left,
                           left + kNearestLevels,
                           mptr<uint8_t>(done),
                           mptr<double>(distance),
                           mptr<int64_t>(index)};
    const typename Backend::Scope scope(points);
    Backend::nearest_points(args, scope);
    return {distance, index};
  }

  static Tensor box_blur(Tensor indicator, int64_t width, int64_t times) {
    const char* op = "box_blur";
    indicator = ready(op, "indicator", indicator, indicator, {-1, -1, -1}, ScalarType::Int);
    STD_TORCH_CHECK(width >= 1 && width <= 9 && width % 2 == 1, op,
                    ": width must be odd and 1 to 9, got ", width);
    STD_TORCH_CHECK(times >= 1 && times <= 3, op, ": times must be 1 to 3, got ", times);
    const std::vector<int64_t> shape{indicator.size(0), indicator.size(1), indicator.size(2)};
    // two grids in turn
    Tensor grids[2] = {gsf::new_empty(indicator, shape, ScalarType::Int),
                       gsf::new_empty(indicator, shape, ScalarType::Int)};
    const typename Backend::Scope scope(indicator);
    const int32_t* in = cptr<int32_t>(indicator);
    int turn = 0;
    for (int axis = 2; axis >= 0; --axis)
      for (int64_t pass = 0; pass < times; ++pass) {
        int32_t* out = mptr<int32_t>(grids[turn]);
        const BoxSumArgs args{
            {shape[0], shape[1], shape[2]}, static_cast<int>(width / 2), axis, in, out};
        Backend::box_sum(args, scope);
        in = out;
        turn = 1 - turn;
      }
    return grids[1 - turn];
  }

  static std::tuple<Tensor, Tensor> distance_transform(Tensor occupied, bool indices) {
    const char* op = "distance_transform";
    occupied = ready(op, "occupied", occupied, occupied, {-1, -1, -1}, ScalarType::Bool);
    const std::vector<int64_t> shape{occupied.size(0), occupied.size(1), occupied.size(2)};
    check_grid(op, shape);
    for (const int64_t n : shape)
      STD_TORCH_CHECK(n <= kMostAlong, op, ": at most ", kMostAlong, " voxels along an axis, got ",
                      n);
    STD_TORCH_CHECK(shape[0] * shape[1] * shape[2] < std::numeric_limits<int32_t>::max(), op,
                    ": the grid is too large");
    const auto grid = [&](bool wanted) {
      return gsf::new_empty(occupied, wanted ? shape : std::vector<int64_t>{0, 0, 0},
                            ScalarType::Int);
    };
    // two grids in turn
    Tensor squares[2] = {grid(true), grid(true)}, stack = grid(true);
    Tensor sources[2] = {grid(indices), grid(indices)};
    const typename Backend::Scope scope(occupied);
    int turn = 0;
    for (int axis = 2; axis >= 0; --axis, turn = 1 - turn) {
      const DistanceArgs args{{shape[0], shape[1], shape[2]},
                              axis,
                              cptr<bool>(occupied),
                              cptr<int32_t>(squares[1 - turn]),
                              indices ? cptr<int32_t>(sources[1 - turn]) : nullptr,
                              mptr<int32_t>(stack),
                              mptr<int32_t>(squares[turn]),
                              indices ? mptr<int32_t>(sources[turn]) : nullptr};
      if (args.voxels()) Backend::distance_pass(args, scope);
    }
    return {squares[1 - turn], sources[1 - turn]};
  }

  static Tensor trilinear(Tensor grid, Tensor place) {
    const char* op = "trilinear";
    check_shape(op, "grid", grid, {-1, -1, -1});
    return dispatch_floating(op, grid, [&]<typename T>() {
      const Tensor held = ready(op, "grid", grid, grid, {-1, -1, -1});
      const Tensor places = ready(op, "place", place, grid, {-1, 3});
      Tensor value = gsf::new_empty(grid, {places.size(0)}, grid.scalar_type());
      const TrilinearArgs<T> args{places.size(0),
                                  {held.size(0), held.size(1), held.size(2)},
                                  cptr<T>(held),
                                  cptr<T>(places),
                                  mptr<T>(value)};
      const typename Backend::Scope scope(held);
      Backend::trilinear(args, scope);
      return value;
    });
  }

  static Tensor value_noise(Tensor voxels, std::vector<double> spacings, std::vector<double> shifts,
                            std::vector<double> weights) {
    const char* op = "value_noise";
    voxels = ready(op, "voxels", voxels, voxels, {-1, 3}, ScalarType::Long);
    const size_t octaves = spacings.size();
    STD_TORCH_CHECK(
        octaves <= kMostOctaves && shifts.size() == octaves && weights.size() == octaves, op,
        ": spacings, shifts and weights must be as many, at most ", kMostOctaves);
    Tensor noise = gsf::new_empty(voxels, {voxels.size(0), 3}, ScalarType::Float);
    ValueNoiseArgs args{};
    args.count = voxels.size(0);
    args.voxel = cptr<int64_t>(voxels);
    args.octaves = static_cast<int>(octaves);
    for (size_t k = 0; k < octaves; ++k) {
      STD_TORCH_CHECK(spacings[k] > 0, op, ": spacings must be positive, got ", spacings[k]);
      args.spacing[k] = spacings[k];
      args.shift[k] = shifts[k];
      args.weight[k] = static_cast<float>(weights[k]);
    }
    args.noise = mptr<float>(noise);
    const typename Backend::Scope scope(voxels);
    Backend::value_noise(args, scope);
    return noise;
  }

  static Tensor hashes(Tensor seed, std::vector<int64_t> turns) {
    const char* op = "hashes";
    seed = ready(op, "seed", seed, seed, {-1}, ScalarType::Long);
    STD_TORCH_CHECK(turns.size() <= kMostTurns, op, ": at most ", kMostTurns, " turns, got ",
                    turns.size());
    HashesArgs args{};
    args.count = seed.size(0);
    args.turns = static_cast<int>(turns.size());
    args.seed = cptr<int64_t>(seed);
    for (size_t k = 0; k < turns.size(); ++k)
      args.salt[k] =
          static_cast<uint32_t>(static_cast<uint64_t>(turns[k])) * 0x9E3779B1u + 0x2545F491u;
    Tensor values = gsf::new_empty(seed, {args.count, args.turns}, ScalarType::Double);
    args.values = mptr<double>(values);
    const typename Backend::Scope scope(seed);
    Backend::hashes(args, scope);
    return values;
  }

  static Tensor label_boxes(Tensor labels, int64_t count) {
    const char* op = "label_boxes";
    labels = ready(op, "labels", labels, labels, {-1, -1, -1}, ScalarType::Short);
    STD_TORCH_CHECK(count >= 0 && count <= 32768, op, ": count must be 0 to 32768, got ", count);
    check_grid(op, {labels.size(0), labels.size(1), labels.size(2)});
    Tensor box = gsf::new_empty(labels, {count, 6}, ScalarType::Int);
    const LabelBoxesArgs args{{labels.size(0), labels.size(1), labels.size(2)},
                              count,
                              cptr<int16_t>(labels),
                              mptr<int32_t>(box)};
    const typename Backend::Scope scope(labels);
    Backend::label_boxes(args, scope);
    return box;
  }

  static Tensor margin_counts(Tensor lead, Tensor first, Tensor second, Tensor offset,
                              double width) {
    const char* op = "margin_counts";
    lead = ready(op, "lead", lead, lead, {-1}, ScalarType::Float);
    first = ready(op, "first", first, lead, {lead.size(0)}, ScalarType::Long);
    second = ready(op, "second", second, lead, {lead.size(0)}, ScalarType::Long);
    offset = ready(op, "offset", offset, lead, {-1}, ScalarType::Double);
    Tensor found = gsf::new_zeros(lead, {2, offset.size(0)}, ScalarType::Long);
    const MarginCountsArgs args{lead.size(0),
                                offset.size(0),
                                cptr<float>(lead),
                                cptr<int64_t>(first),
                                cptr<int64_t>(second),
                                cptr<double>(offset),
                                width,
                                mptr<int64_t>(found)};
    const typename Backend::Scope scope(lead);
    Backend::margin_counts(args, scope);
    return found;
  }

  template <typename Library>
  static void register_all(Library& m) {
    GSF_IMPL(SpatialOps, nearest_labels);
    GSF_IMPL(SpatialOps, largest_shares);
    GSF_IMPL(SpatialOps, nearest_points);
    GSF_IMPL(SpatialOps, box_blur);
    GSF_IMPL(SpatialOps, distance_transform);
    GSF_IMPL(SpatialOps, trilinear);
    GSF_IMPL(SpatialOps, value_noise);
    GSF_IMPL(SpatialOps, hashes);
    GSF_IMPL(SpatialOps, label_boxes);
    GSF_IMPL(SpatialOps, margin_counts);
  }

 private:
  static void check_grid(const char* op, const std::vector<int64_t>& shape) {
    STD_TORCH_CHECK(shape.size() == 3, op, ": shape must have 3 sizes, got ", shape.size());
    double voxels = 1.0;
    for (const int64_t n : shape) {
      STD_TORCH_CHECK(n >= 0, op, ": sizes must not be negative, got ", n);
      voxels *= double(n);
    }
    STD_TORCH_CHECK(voxels < 1e12, op, ": the grid is too large");
  }
};

}  // namespace gsf
