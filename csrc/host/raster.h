// The rasterizer's operators on the host, once for every backend: checks, allocation, dtype. A
// backend supplies `kTile` (edge of its lists' tiles), `stride(features)` (numbers saved per
// splat), `kSavesOrder`, `kWritesGradients` (its adjoint fills every gradient, so none needs
// zeroing), `Plan<T>` (project, sort, count; then bin and blend) and `backward<T>`.
#pragma once

#include "core/raster/raster.h"
#include "torch_api.h"

namespace gsf {

inline constexpr const char* kRasterOp = "rasterize";

struct RasterInputs {
  Tensor means, opacities, viewmat, intrinsics;
  OptTensor quats, scales, covars, sh, colors, background, normals, groups, offset, absolute;

  bool batched() const { return viewmat.dim() == 3; }
  int64_t cameras() const { return batched() ? viewmat.size(0) : 1; }
};

// Sizes with the camera axis in front when the cameras came with one.
inline std::vector<int64_t> per_camera(const RasterInputs& in,
                                       std::initializer_list<int64_t> rest) {
  std::vector<int64_t> sizes;
  if (in.batched()) sizes.push_back(in.cameras());
  sizes.insert(sizes.end(), rest.begin(), rest.end());
  return sizes;
}

inline void check_raster_tensor(const char* name, const OptTensor& t, const Tensor& like,
                                const std::vector<int64_t>& shape) {
  if (!t) return;
  check_shape(kRasterOp, name, *t, shape);
  check_dtype(kRasterOp, name, *t, like.scalar_type());
  check_same_device(kRasterOp, name, *t, like);
}

// Makes every tensor contiguous and refuses what the kernels could not read safely.
inline void prepare_raster_inputs(RasterInputs& in) {
  const int64_t n = in.means.dim() == 2 ? in.means.size(0) : -1;
  check_raster_tensor("means", in.means, in.means, {n, 3});
  check_raster_tensor("opacities", in.opacities, in.means, {n});
  check_raster_tensor("viewmat", in.viewmat, in.means, per_camera(in, {4, 4}));
  check_raster_tensor("K", in.intrinsics, in.means, per_camera(in, {3, 3}));
  STD_TORCH_CHECK(in.cameras() >= 1, kRasterOp, ": viewmat must hold at least one camera");
  STD_TORCH_CHECK(n < INT32_MAX / in.cameras(), kRasterOp, ": ", n, " Gaussians in ", in.cameras(),
                  " cameras are more than 2^31 splats; render fewer cameras at once");
  check_raster_tensor("quats", in.quats, in.means, {n, 4});
  check_raster_tensor("scales", in.scales, in.means, {n, 3});
  check_raster_tensor("covars", in.covars, in.means, {n, 6});
  check_raster_tensor("sh", in.sh, in.means, {n, -1, 3});
  check_raster_tensor("colors", in.colors, in.means, {n, -1});
  check_raster_tensor("normals", in.normals, in.means, {n, -1});
  check_raster_tensor("means2d_offset", in.offset, in.means, per_camera(in, {n, 2}));
  check_raster_tensor("means2d_absgrad", in.absolute, in.means, per_camera(in, {n, 2}));
  STD_TORCH_CHECK(in.covars ? !in.quats && !in.scales : in.quats && in.scales, kRasterOp,
                  ": pass either quats and scales, or covars");
  STD_TORCH_CHECK(in.sh.has_value() != in.colors.has_value(), kRasterOp,
                  ": pass either sh or colors");
  if (in.groups) {
    check_shape(kRasterOp, "groups", *in.groups, {n});
    check_dtype(kRasterOp, "groups", *in.groups, ScalarType::Int);
    check_same_device(kRasterOp, "groups", *in.groups, in.means);
  }
  for (Tensor* t : {&in.means, &in.opacities, &in.viewmat, &in.intrinsics})
    *t = gsf::contiguous(*t);
  for (OptTensor* t : {&in.quats, &in.scales, &in.covars, &in.sh, &in.colors, &in.background,
                       &in.normals, &in.groups, &in.offset})
    if (*t) *t = gsf::contiguous(**t);
}

inline int raster_sh_degree(const Tensor& sh) {
  for (int degree = 0; degree <= 3; ++degree)
    if (sh.size(1) == sh_coefficients(degree)) return degree;
  STD_TORCH_CHECK(false, kRasterOp, ": sh must hold 1, 4, 9 or 16 coefficients, got ",
                  shape_string(sh));
  return -1;
}

template <class Backend, typename T>
RasterArgs<T> raster_args(const RasterInputs& in, int64_t width, int64_t height, bool antialiased,
                          bool depth, double near, double far) {
  STD_TORCH_CHECK(width > 0 && height > 0 && width <= 65536 && height <= 65536, kRasterOp,
                  ": width and height must lie in 1..65536, got ", width, " x ", height);
  RasterArgs<T> a{};
  const auto pointer = [](const OptTensor& t) { return t ? cptr<T>(*t) : nullptr; };
  a.means = cptr<T>(in.means);
  a.opacities = cptr<T>(in.opacities);
  a.viewmat = cptr<T>(in.viewmat);
  a.intrinsics = cptr<T>(in.intrinsics);
  a.quats = pointer(in.quats);
  a.scales = pointer(in.scales);
  a.covars = pointer(in.covars);
  a.sh = pointer(in.sh);
  a.colors = pointer(in.colors);
  a.normals = pointer(in.normals);
  a.background = pointer(in.background);
  a.offset = pointer(in.offset);
  a.groups = in.groups ? cptr<int32_t>(*in.groups) : nullptr;
  a.count = in.means.size(0);
  a.cameras = static_cast<int>(in.cameras());
  a.sh_degree = in.sh ? raster_sh_degree(*in.sh) : -1;
  a.channels = in.sh ? 3 : static_cast<int>(in.colors->size(1));
  STD_TORCH_CHECK(a.channels >= 1 && a.channels <= kMaxChannels, kRasterOp,
                  ": colors must have 1 to ", kMaxChannels, " channels, got ", a.channels);
  if (in.background && in.background->dim() == 2) {
    check_raster_tensor("background", in.background, in.means, {in.cameras(), a.channels});
    a.background_stride = a.channels;
  } else {
    check_raster_tensor("background", in.background, in.means, {a.channels});
  }
  a.vectors = in.normals ? static_cast<int>(in.normals->size(1)) : 0;
  STD_TORCH_CHECK(!in.normals || (a.vectors >= 3 && a.channels + a.vectors < kMaxFeatures),
                  "rasterize: normals must have at least 3 columns, and at most ",
                  kMaxFeatures - 1 - a.channels, " beside ", a.channels, " channels, got ",
                  a.vectors);
  a.has_depth = depth;
  a.features = a.channels + a.vectors + (depth ? 1 : 0);
  a.stride = Backend::stride(a.features);
  a.width = static_cast<int>(width);
  a.height = static_cast<int>(height);
  a.tile = Backend::kTile;
  a.tiles_x = (a.width + a.tile - 1) / a.tile;
  a.tiles_y = (a.height + a.tile - 1) / a.tile;
  STD_TORCH_CHECK(int64_t(a.tiles()) * a.cameras < INT32_MAX, kRasterOp,
                  ": the images of all cameras hold more than 2^31 tiles; render fewer at once");
  a.antialiased = antialiased;
  a.near = static_cast<T>(near);
  a.far = static_cast<T>(far);
  return a;
}

template <class Backend>
struct RasterOps {
  using Forward = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor,
                             Tensor, Tensor>;
  using Backward = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor,
                              Tensor, Tensor, Tensor>;

  static Forward rasterize(Tensor means, Tensor opacities, Tensor viewmat, Tensor intrinsics,
                           OptTensor quats, OptTensor scales, OptTensor covars, OptTensor sh,
                           OptTensor colors, OptTensor background, OptTensor normals,
                           OptTensor groups, OptTensor offset, OptTensor absolute, int64_t width,
                           int64_t height, bool antialiased, bool contribution, bool depth,
                           bool median_depth, double near, double far, bool) {
    RasterInputs in{means, opacities, viewmat,    intrinsics, quats,  scales, covars,
                    sh,    colors,    background, normals,    groups, offset, absolute};
    prepare_raster_inputs(in);
    typename Backend::Scope scope(in.means);
    return dispatch_floating(kRasterOp, in.means, [&]<typename T>() -> Forward {
      RasterArgs<T> a = raster_args<Backend, T>(in, width, height, antialiased, depth, near, far);
      const Tensor& like = in.means;
      const ScalarType real = scalar_type_of<T>();
      const int64_t h = a.height, w = a.width, n = a.count;
      const auto pixels = [&](int64_t channels) {
        return gsf::new_empty(like, per_camera(in, {h, w, channels}), real);
      };
      const auto plane = [&](bool wanted) {
        return wanted ? gsf::new_empty(like, per_camera(in, {h, w}), real)
                      : gsf::new_empty(like, {0}, real);
      };
      Tensor image = pixels(a.channels);
      Tensor alpha = plane(true), depths = plane(depth), median = plane(median_depth);
      Tensor normal = a.vectors ? pixels(a.vectors) : gsf::new_empty(like, {0}, real);
      Tensor sums = gsf::new_zeros(like, {contribution ? n : 0}, real);
      Tensor radii = gsf::new_empty(like, per_camera(in, {n}), ScalarType::Int);
      Tensor splats = gsf::new_empty(like, {a.splat_count(), a.stride}, real);
      Tensor order =
          gsf::new_empty(like, {Backend::kSavesOrder ? a.splat_count() : 0}, ScalarType::Int);
      Tensor tile_start =
          gsf::new_empty(like, {int64_t(a.tiles()) * a.cameras + 1}, ScalarType::Int);
      a.image = mptr<T>(image);
      a.alpha = mptr<T>(alpha);
      a.depth = depth ? mptr<T>(depths) : nullptr;
      a.median = median_depth ? mptr<T>(median) : nullptr;
      a.normal = a.vectors ? mptr<T>(normal) : nullptr;
      a.contribution = contribution ? mptr<T>(sums) : nullptr;
      a.radii = mptr<int32_t>(radii);
      a.splats = mptr<T>(splats);
      a.order = Backend::kSavesOrder ? mptr<int32_t>(order) : nullptr;
      a.tile_start = mptr<int32_t>(tile_start);
      typename Backend::template Plan<T> plan(a, like, scope);
      a.instance_count = plan.instance_count();
      STD_TORCH_CHECK(a.instance_count <= INT32_MAX, kRasterOp, ": the splats cover ",
                      a.instance_count,
                      " tiles in total, more than 2^31 - 1; remove the splats that "
                      "fill the image or render it in parts");
      Tensor instances = gsf::new_empty(like, {a.instance_count}, ScalarType::Int);
      a.instances = mptr<int32_t>(instances);
      plan.blend();
      return {image, alpha,  depths, median,     normal,   sums,
              radii, splats, order,  tile_start, instances};
    });
  }

  // Absent inputs get an empty gradient.
  static Backward rasterize_backward(
      OptTensor grad_image, OptTensor grad_alpha, OptTensor grad_depth, OptTensor grad_normal,
      Tensor image, Tensor alpha, Tensor depth, Tensor normal, Tensor splats, Tensor order,
      Tensor tile_start, Tensor instances, Tensor means, Tensor opacities, Tensor viewmat,
      Tensor intrinsics, OptTensor quats, OptTensor scales, OptTensor covars, OptTensor sh,
      OptTensor colors, OptTensor background, OptTensor normals, OptTensor groups, OptTensor offset,
      OptTensor absolute, int64_t width, int64_t height, bool antialiased, bool has_depth,
      double near, double far, bool deterministic) {
    RasterInputs in{means, opacities, viewmat,    intrinsics, quats,  scales, covars,
                    sh,    colors,    background, normals,    groups, offset, absolute};
    prepare_raster_inputs(in);
    typename Backend::Scope scope(in.means);
    return dispatch_floating(kRasterOp, in.means, [&]<typename T>() -> Backward {
      RasterGradArgs<T> b{};
      b.forward = raster_args<Backend, T>(in, width, height, antialiased, has_depth, near, far);
      RasterArgs<T>& a = b.forward;
      const Tensor& like = in.means;
      const int64_t h = a.height, w = a.width;
      const std::vector<int64_t> pixels = per_camera(in, {h, w, a.channels});
      const std::vector<int64_t> plane = per_camera(in, {h, w}), none{0};
      const std::vector<int64_t> vectors = a.vectors ? per_camera(in, {h, w, a.vectors}) : none;
      check_raster_tensor("image", image, like, pixels);
      check_raster_tensor("alpha", alpha, like, plane);
      check_raster_tensor("depth", depth, like, has_depth ? plane : none);
      check_raster_tensor("normal", normal, like, vectors);
      check_raster_tensor("splats", splats, like, {a.splat_count(), a.stride});
      check_shape(kRasterOp, "order", order, {Backend::kSavesOrder ? a.splat_count() : 0});
      check_shape(kRasterOp, "tile_start", tile_start, {int64_t(a.tiles()) * a.cameras + 1});
      check_shape(kRasterOp, "instances", instances, {-1});
      for (const Tensor* t : {&order, &tile_start, &instances}) {
        check_dtype(kRasterOp, "saved lists", *t, ScalarType::Int);
        check_same_device(kRasterOp, "saved lists", *t, like);
      }
      STD_TORCH_CHECK(instances.numel() <= INT32_MAX, kRasterOp, ": too many instances");
      if (!has_depth) grad_depth.reset();
      if (!a.vectors) grad_normal.reset();
      for (OptTensor* g : {&grad_image, &grad_alpha, &grad_depth, &grad_normal})
        if (*g) *g = gsf::contiguous(**g);
      check_raster_tensor("grad_image", grad_image, like, pixels);
      check_raster_tensor("grad_alpha", grad_alpha, like, plane);
      check_raster_tensor("grad_depth", grad_depth, like, plane);
      check_raster_tensor("grad_normal", grad_normal, like, vectors);
      const Tensor saved[] = {gsf::contiguous(image), gsf::contiguous(alpha),
                              gsf::contiguous(depth), gsf::contiguous(normal),
                              gsf::contiguous(splats)};
      const Tensor lists[] = {gsf::contiguous(order), gsf::contiguous(tile_start),
                              gsf::contiguous(instances)};
      a.image = const_cast<T*>(cptr<T>(saved[0]));  // read only in the adjoint
      a.alpha = const_cast<T*>(cptr<T>(saved[1]));
      a.depth = has_depth ? const_cast<T*>(cptr<T>(saved[2])) : nullptr;
      a.normal = a.vectors ? const_cast<T*>(cptr<T>(saved[3])) : nullptr;
      a.splats = const_cast<T*>(cptr<T>(saved[4]));
      a.order = Backend::kSavesOrder ? const_cast<int32_t*>(cptr<int32_t>(lists[0])) : nullptr;
      a.tile_start = const_cast<int32_t*>(cptr<int32_t>(lists[1]));
      a.instances = const_cast<int32_t*>(cptr<int32_t>(lists[2]));
      a.instance_count = lists[2].numel();
      const auto pointer = [](const OptTensor& t) { return t ? cptr<T>(*t) : nullptr; };
      b.grad_image = pointer(grad_image);
      b.grad_alpha = pointer(grad_alpha);
      b.grad_depth = pointer(grad_depth);
      b.grad_normal = pointer(grad_normal);

      const auto zeros_like = [&](const OptTensor& t) {
        return t ? torch::stable::new_zeros(like, t->sizes(), scalar_type_of<T>())
                 : gsf::new_empty(like, {0}, scalar_type_of<T>());
      };
      const auto gradient_of = [&](const OptTensor& t) {
        return t && Backend::kWritesGradients
                   ? torch::stable::new_empty(like, t->sizes(), scalar_type_of<T>())
                   : zeros_like(t);
      };
      Backward out{gradient_of(in.means),  gradient_of(in.opacities), gradient_of(in.quats),
                   gradient_of(in.scales), gradient_of(in.covars),    gradient_of(in.sh),
                   gradient_of(in.colors), zeros_like(in.background), gradient_of(in.normals),
                   gradient_of(in.offset), gradient_of(in.absolute)};
      b.grad_means = mptr<T>(std::get<0>(out));
      b.grad_opacities = mptr<T>(std::get<1>(out));
      b.grad_quats = in.quats ? mptr<T>(std::get<2>(out)) : nullptr;
      b.grad_scales = in.scales ? mptr<T>(std::get<3>(out)) : nullptr;
      b.grad_covars = in.covars ? mptr<T>(std::get<4>(out)) : nullptr;
      b.grad_sh = in.sh ? mptr<T>(std::get<5>(out)) : nullptr;
      b.grad_colors = in.colors ? mptr<T>(std::get<6>(out)) : nullptr;
      b.grad_background = in.background ? mptr<T>(std::get<7>(out)) : nullptr;
      b.grad_normals = in.normals ? mptr<T>(std::get<8>(out)) : nullptr;
      b.grad_offset = in.offset ? mptr<T>(std::get<9>(out)) : nullptr;
      b.grad_absolute = in.absolute ? mptr<T>(std::get<10>(out)) : nullptr;
      b.deterministic = deterministic;
      Backend::template backward<T>(b, like, scope);
      return out;
    });
  }

  static void register_all(Library& m) {
    GSF_IMPL(RasterOps, rasterize);
    GSF_IMPL(RasterOps, rasterize_backward);
  }
};

}  // namespace gsf
