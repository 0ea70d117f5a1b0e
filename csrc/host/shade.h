// Checks, allocation and dtype dispatch of the shading op, once for both back ends.
#pragma once

#include "core/shade/args.h"
#include "torch_api.h"

namespace gsf {

template <class Backend>
struct ShadeOps {
  static Tensor shade(Tensor image, Tensor alpha, Tensor depth, Tensor normal, OptTensor gloss,
                      Tensor viewmat, Tensor intrinsics, Tensor lamps, Tensor environment,
                      Tensor background, OptTensor map_depth, OptTensor map_alpha,
                      OptTensor map_cameras, OptTensor occupancy, OptTensor grid_frame,
                      int64_t nodes, double occlusion, OptTensor studio) {
    const char* op = "shade";
    check_shape(op, "image", image, {-1, -1, 3});
    const int64_t h = image.size(0), w = image.size(1);
    check_shape(op, "alpha", alpha, {h, w});
    check_shape(op, "depth", depth, {h, w});
    check_shape(op, "normal", normal, {h, w, -1});
    STD_TORCH_CHECK(normal.size(2) >= (gloss ? 3 : 5), op,
                    ": normal must have 3 columns, or at least 5 when no gloss is given, got ",
                    normal.size(2));
    check_shape(op, "viewmat", viewmat, {4, 4});
    check_shape(op, "K", intrinsics, {3, 3});
    check_shape(op, "lamps", lamps, {-1, kLampColumns});
    check_shape(op, "environment", environment, {9, 3});
    check_shape(op, "background", background, {3});
    if (gloss) check_shape(op, "gloss", *gloss, {2});
    const bool shadows = map_depth.has_value();
    STD_TORCH_CHECK(shadows == map_alpha.has_value() && shadows == map_cameras.has_value(), op,
                    ": shadow maps need depth, alpha and cameras");
    if (shadows) {
      const int64_t maps = map_depth->size(0),
                    texels = map_depth->dim() == 3 ? map_depth->size(1) : 0;
      check_shape(op, "map_depth", *map_depth, {-1, texels, texels});
      check_shape(op, "map_alpha", *map_alpha, {maps, texels, texels});
      check_shape(op, "map_cameras", *map_cameras, {maps, kMapColumns});
      STD_TORCH_CHECK(maps > 0 && texels > 0 && maps < 4096 && texels < 65536, op,
                      ": shadow maps must be 1 to 4095 of 1 to 65535 texels");
    }
    STD_TORCH_CHECK(occupancy.has_value() == grid_frame.has_value(), op,
                    ": occupancy needs its frame");
    if (occupancy) {
      STD_TORCH_CHECK(nodes >= 16 && nodes % 16 == 0 && nodes <= 2048, op,
                      ": nodes must be a multiple of 16 up to 2048, got ", nodes);
      int64_t cells = 0;
      for (int level = 0; level < kOcclusionLevels; ++level) {
        const int64_t side = nodes >> level;
        cells += side * side * side;
      }
      check_shape(op, "occupancy", *occupancy, {cells});
      check_shape(op, "grid_frame", *grid_frame, {4});
    }
    if (studio) check_shape(op, "studio", *studio, {kStudioColumns});
    for (Tensor* t : {&image, &alpha, &depth, &normal, &viewmat, &intrinsics, &lamps, &environment,
                      &background})
      prepare(op, *t, image);
    for (OptTensor* t :
         {&gloss, &map_depth, &map_alpha, &map_cameras, &occupancy, &grid_frame, &studio})
      if (*t) prepare(op, **t, image);
    Tensor out = gsf::new_empty(image, {h, w, 3}, image.scalar_type());
    const typename Backend::Scope scope(image);
    dispatch_floating(op, image, [&]<typename T>() {
      if (h == 0 || w == 0) return;
      const ShadeArgs<T> args{w,
                              h,
                              cptr<T>(image),
                              cptr<T>(alpha),
                              cptr<T>(depth),
                              cptr<T>(normal),
                              static_cast<int>(normal.size(2)),
                              cptr<T>(gloss),
                              cptr<T>(viewmat),
                              cptr<T>(intrinsics),
                              cptr<T>(lamps),
                              cptr<T>(environment),
                              cptr<T>(background),
                              static_cast<int>(lamps.size(0)),
                              cptr<T>(map_depth),
                              cptr<T>(map_alpha),
                              cptr<T>(map_cameras),
                              shadows ? static_cast<int>(map_depth->size(0)) : 0,
                              shadows ? static_cast<int>(map_depth->size(1)) : 0,
                              cptr<T>(occupancy),
                              cptr<T>(grid_frame),
                              static_cast<int>(nodes),
                              T(occlusion),
                              cptr<T>(studio),
                              mptr<T>(out)};
      Backend::shade(args, scope);
    });
    return out;
  }

  static void register_all(Library& m) { GSF_IMPL(ShadeOps, shade); }

 private:
  static void prepare(const char* op, Tensor& t, const Tensor& like) {
    check_dtype(op, "every tensor", t, like.scalar_type());
    check_same_device(op, "every tensor", t, like);
    t = gsf::contiguous(t);
  }
};

}  // namespace gsf
