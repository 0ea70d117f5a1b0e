// The rasterizer's operators on the host, once for every backend: checks, allocation, dtype. A
// backend supplies `Plan<T>` (project, sort, count; then bin and blend) and `backward<T>`.
#pragma once

#include "core/raster.h"
#include "torch_api.h"

namespace gsf {

inline constexpr const char* kRasterOp = "rasterize";

struct RasterInputs {
  Tensor means, opacities, viewmat, intrinsics;
  OptTensor quats, scales, covars, sh, colors, background, normals, groups, offset;
};

inline void check_raster_tensor(const char* name, const OptTensor& t, const Tensor& like,
                                std::initializer_list<int64_t> shape) {
  if (!t) return;
  check_shape(kRasterOp, name, *t, shape);
  check_dtype(kRasterOp, name, *t, like.scalar_type());
  check_same_device(kRasterOp, name, *t, like);
}

// Makes every tensor contiguous and refuses what the kernels could not read safely.
inline void prepare_raster_inputs(RasterInputs& in) {
  const int64_t n = in.means.dim() == 2 ? in.means.size(0) : -1;
  check_raster_tensor("means", in.means, in.means, {n, 3});
  STD_TORCH_CHECK(n < INT32_MAX, kRasterOp, ": means must hold fewer than 2^31 - 1 rows, got ", n);
  check_raster_tensor("opacities", in.opacities, in.means, {n});
  check_raster_tensor("viewmat", in.viewmat, in.means, {4, 4});
  check_raster_tensor("K", in.intrinsics, in.means, {3, 3});
  check_raster_tensor("quats", in.quats, in.means, {n, 4});
  check_raster_tensor("scales", in.scales, in.means, {n, 3});
  check_raster_tensor("covars", in.covars, in.means, {n, 6});
  check_raster_tensor("sh", in.sh, in.means, {n, -1, 3});
  check_raster_tensor("colors", in.colors, in.means, {n, -1});
  check_raster_tensor("normals", in.normals, in.means, {n, 3});
  check_raster_tensor("means2d_offset", in.offset, in.means, {n, 2});
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

template <typename T>
RasterArgs<T> raster_args(const RasterInputs& in, int64_t width, int64_t height, bool antialiased,
                          double near, double far) {
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
  a.sh_degree = in.sh ? raster_sh_degree(*in.sh) : -1;
  a.channels = in.sh ? 3 : static_cast<int>(in.colors->size(1));
  STD_TORCH_CHECK(a.channels >= 1 && a.channels <= kMaxChannels, kRasterOp,
                  ": colors must have 1 to ", kMaxChannels, " channels, got ", a.channels);
  check_raster_tensor("background", in.background, in.means, {a.channels});
  a.has_normals = in.normals.has_value();
  a.features = a.channels + (a.has_normals ? 3 : 0) + 1;
  a.stride = splat_stride(a.features);
  a.width = static_cast<int>(width);
  a.height = static_cast<int>(height);
  a.tiles_x = (a.width + kTile - 1) / kTile;
  a.tiles_y = (a.height + kTile - 1) / kTile;
  a.antialiased = antialiased;
  a.near = static_cast<T>(near);
  a.far = static_cast<T>(far);
  return a;
}

template <class Backend>
struct RasterOps {
  using Forward =
      std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;
  using Backward =
      std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;

  static Forward forward(Tensor means, Tensor opacities, Tensor viewmat, Tensor intrinsics,
                         OptTensor quats, OptTensor scales, OptTensor covars, OptTensor sh,
                         OptTensor colors, OptTensor background, OptTensor normals,
                         OptTensor groups, OptTensor offset, int64_t width, int64_t height,
                         bool antialiased, bool contribution, double near, double far) {
    RasterInputs in{means, opacities, viewmat,    intrinsics, quats,  scales, covars,
                    sh,    colors,    background, normals,    groups, offset};
    prepare_raster_inputs(in);
    typename Backend::Scope scope(in.means);
    return dispatch_floating(kRasterOp, in.means, [&]<typename T>() -> Forward {
      RasterArgs<T> a = raster_args<T>(in, width, height, antialiased, near, far);
      const Tensor& like = in.means;
      const ScalarType real = scalar_type_of<T>();
      const int64_t h = a.height, w = a.width, n = a.count;
      Tensor image = gsf::new_empty(like, {h, w, a.channels}, real);
      Tensor alpha = gsf::new_empty(like, {h, w}, real);
      Tensor depth = gsf::new_empty(like, {h, w}, real);
      Tensor normal = gsf::new_empty(like, {h, w, a.has_normals ? 3 : 0}, real);
      Tensor sums = gsf::new_zeros(like, {contribution ? n : 0}, real);
      Tensor radii = gsf::new_empty(like, {n}, ScalarType::Int);
      Tensor splats = gsf::new_empty(like, {n, a.stride}, real);
      Tensor order = gsf::new_empty(like, {n}, ScalarType::Int);
      Tensor tile_start =
          gsf::new_empty(like, {int64_t(a.tiles_x) * a.tiles_y + 1}, ScalarType::Int);
      a.image = mptr<T>(image);
      a.alpha = mptr<T>(alpha);
      a.depth = mptr<T>(depth);
      a.normal = a.has_normals ? mptr<T>(normal) : nullptr;
      a.contribution = contribution ? mptr<T>(sums) : nullptr;
      a.radii = mptr<int32_t>(radii);
      a.splats = mptr<T>(splats);
      a.order = mptr<int32_t>(order);
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
      return {image, alpha, depth, normal, sums, radii, splats, order, tile_start, instances};
    });
  }

  // Absent inputs get an empty gradient.
  static Backward backward(OptTensor grad_image, OptTensor grad_alpha, OptTensor grad_depth,
                           OptTensor grad_normal, Tensor image, Tensor alpha, Tensor depth,
                           Tensor normal, Tensor splats, Tensor order, Tensor tile_start,
                           Tensor instances, Tensor means, Tensor opacities, Tensor viewmat,
                           Tensor intrinsics, OptTensor quats, OptTensor scales, OptTensor covars,
                           OptTensor sh, OptTensor colors, OptTensor background, OptTensor normals,
                           OptTensor groups, OptTensor offset, int64_t width, int64_t height,
                           bool antialiased, double near, double far) {
    RasterInputs in{means, opacities, viewmat,    intrinsics, quats,  scales, covars,
                    sh,    colors,    background, normals,    groups, offset};
    prepare_raster_inputs(in);
    typename Backend::Scope scope(in.means);
    return dispatch_floating(kRasterOp, in.means, [&]<typename T>() -> Backward {
      RasterGradArgs<T> b{};
      b.forward = raster_args<T>(in, width, height, antialiased, near, far);
      RasterArgs<T>& a = b.forward;
      const Tensor& like = in.means;
      const int64_t h = a.height, w = a.width, n = a.count;
      check_raster_tensor("image", image, like, {h, w, a.channels});
      check_raster_tensor("alpha", alpha, like, {h, w});
      check_raster_tensor("depth", depth, like, {h, w});
      check_raster_tensor("normal", normal, like, {h, w, a.has_normals ? 3 : 0});
      check_raster_tensor("splats", splats, like, {n, a.stride});
      check_shape(kRasterOp, "order", order, {n});
      check_shape(kRasterOp, "tile_start", tile_start, {int64_t(a.tiles_x) * a.tiles_y + 1});
      check_shape(kRasterOp, "instances", instances, {-1});
      for (const Tensor* t : {&order, &tile_start, &instances})
        check_dtype(kRasterOp, "saved lists", *t, ScalarType::Int);
      for (OptTensor* g : {&grad_image, &grad_alpha, &grad_depth, &grad_normal})
        if (*g) *g = gsf::contiguous(**g);
      check_raster_tensor("grad_image", grad_image, like, {h, w, a.channels});
      check_raster_tensor("grad_alpha", grad_alpha, like, {h, w});
      check_raster_tensor("grad_depth", grad_depth, like, {h, w});
      check_raster_tensor("grad_normal", grad_normal, like, {h, w, a.has_normals ? 3 : 0});
      const Tensor saved[] = {gsf::contiguous(image), gsf::contiguous(alpha),
                              gsf::contiguous(depth), gsf::contiguous(normal),
                              gsf::contiguous(splats)};
      const Tensor lists[] = {gsf::contiguous(order), gsf::contiguous(tile_start),
                              gsf::contiguous(instances)};
      a.image = const_cast<T*>(cptr<T>(saved[0]));  // read only in the adjoint
      a.alpha = const_cast<T*>(cptr<T>(saved[1]));
      a.depth = const_cast<T*>(cptr<T>(saved[2]));
      a.normal = a.has_normals ? const_cast<T*>(cptr<T>(saved[3])) : nullptr;
      a.splats = const_cast<T*>(cptr<T>(saved[4]));
      a.order = const_cast<int32_t*>(cptr<int32_t>(lists[0]));
      a.tile_start = const_cast<int32_t*>(cptr<int32_t>(lists[1]));
      a.instances = const_cast<int32_t*>(cptr<int32_t>(lists[2]));
      a.instance_count = lists[2].numel();
      const auto pointer = [](const OptTensor& t) { return t ? cptr<T>(*t) : nullptr; };
      b.grad_image = pointer(grad_image);
      b.grad_alpha = pointer(grad_alpha);
      b.grad_depth = pointer(grad_depth);
      b.grad_normal = a.has_normals ? pointer(grad_normal) : nullptr;

      const auto zeros_like = [&](const OptTensor& t) {
        return t ? torch::stable::new_zeros(like, t->sizes(), scalar_type_of<T>())
                 : gsf::new_zeros(like, {0}, scalar_type_of<T>());
      };
      Backward out{zeros_like(in.means),  zeros_like(in.opacities),  zeros_like(in.quats),
                   zeros_like(in.scales), zeros_like(in.covars),     zeros_like(in.sh),
                   zeros_like(in.colors), zeros_like(in.background), zeros_like(in.normals),
                   zeros_like(in.offset)};
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
      Backend::template backward<T>(b, like, scope);
      return out;
    });
  }
};

}  // namespace gsf
