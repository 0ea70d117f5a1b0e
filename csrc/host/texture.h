// Checks and allocation of the ops of a texture's synthesis, once for both back ends.
#pragma once

#include "core/texture.h"
#include "torch_api.h"

namespace gsf {

// A backend says whether patch_votes needs room for `row` (kRows).
template <class Backend>
struct TextureOps {
  static Tensor rows_between(Tensor ordered, Tensor low, Tensor high, Tensor share) {
    const char* op = "rows_between";
    ordered = ready(op, "ordered", ordered, ordered, {-1, -1, -1}, ScalarType::Float);
    const int64_t parts = ordered.size(0), columns = ordered.size(2);
    low = ready(op, "low", low, ordered, {parts, -1}, ScalarType::Long);
    const int64_t knots = low.size(1);
    high = ready(op, "high", high, ordered, {parts, knots}, ScalarType::Long);
    share = ready(op, "share", share, ordered, {parts, knots}, ScalarType::Float);
    Tensor out = gsf::new_empty(ordered, {parts, knots, columns}, ScalarType::Float);
    const RowsBetweenArgs args{parts,
                               ordered.size(1),
                               columns,
                               knots,
                               cptr<float>(ordered),
                               cptr<int64_t>(low),
                               cptr<int64_t>(high),
                               cptr<float>(share),
                               mptr<float>(out)};
    const typename Backend::Scope scope(ordered);
    if (args.items() > 0) Backend::rows_between(args, scope);
    return out;
  }

  static Tensor quantile_shift(Tensor values, Tensor have, Tensor want) {
    const char* op = "quantile_shift";
    values = ready(op, "values", values, values, {-1, -1, -1}, ScalarType::Float);
    const int64_t parts = values.size(0), columns = values.size(2);
    have = ready(op, "have", have, values, {parts, -1, columns}, ScalarType::Float);
    const int64_t knots = have.size(1);
    STD_TORCH_CHECK(knots >= 2, op, ": have must hold at least two quantiles, got ", knots);
    want = ready(op, "want", want, values, {parts, knots, columns}, ScalarType::Float);
    Tensor moves = gsf::new_empty(values, {parts, values.size(1), columns}, ScalarType::Float);
    const QuantileShiftArgs args{parts,
                                 values.size(1),
                                 columns,
                                 knots,
                                 cptr<float>(values),
                                 cptr<float>(have),
                                 cptr<float>(want),
                                 mptr<float>(moves)};
    const typename Backend::Scope scope(values);
    if (args.items() > 0) Backend::quantile_shift(args, scope);
    return moves;
  }

  static void patch_votes(Tensor center, Tensor offset, Tensor best, Tensor patches, Tensor weight,
                          Tensor falloff, Tensor total, Tensor share) {
    const char* op = "patch_votes";
    patches = ready(op, "patches", patches, patches, {-1, -1, 3}, ScalarType::Float);
    center = ready(op, "center", center, patches, {-1}, ScalarType::Long);
    const int64_t count = center.size(0), places = patches.size(1);
    offset = ready(op, "offset", offset, patches, {places}, ScalarType::Long);
    best = ready(op, "best", best, patches, {count}, ScalarType::Long);
    weight = ready(op, "weight", weight, patches, {count}, ScalarType::Float);
    falloff = ready(op, "falloff", falloff, patches, {places}, ScalarType::Float);
    check_shape(op, "total", total, {-1, 3});
    const int64_t voxels = total.size(0);
    check_shape(op, "share", share, {voxels});
    check_dtype(op, "total", total, ScalarType::Float);
    check_dtype(op, "share", share, ScalarType::Float);
    check_same_device(op, "total", total, patches);
    check_same_device(op, "share", share, patches);
    STD_TORCH_CHECK(total.is_contiguous() && share.is_contiguous(), op,
                    ": total and share are changed in place and must be contiguous");
    STD_TORCH_CHECK(count <= INT32_MAX, op, ": at most 2^31 - 1 patches, got ", count);
    Tensor row = gsf::new_empty(patches, {Backend::kRows ? voxels : 0}, ScalarType::Int);
    const PatchVotesArgs args{count,
                              places,
                              patches.size(0),
                              voxels,
                              cptr<int64_t>(center),
                              cptr<int64_t>(offset),
                              cptr<int64_t>(best),
                              cptr<float>(patches),
                              cptr<float>(weight),
                              cptr<float>(falloff),
                              mptr<float>(total),
                              mptr<float>(share),
                              mptr<int32_t>(row)};
    const typename Backend::Scope scope(patches);
    if (count * places * voxels > 0) Backend::patch_votes(args, scope);
  }

  static void register_all(Library& m) {
    GSF_IMPL(TextureOps, rows_between);
    GSF_IMPL(TextureOps, quantile_shift);
    GSF_IMPL(TextureOps, patch_votes);
  }
};

}  // namespace gsf
