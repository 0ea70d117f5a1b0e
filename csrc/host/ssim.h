// Checks, allocation and dtype dispatch of SSIM and of the photometric loss, once for both back
// ends.
#pragma once

#include "core/train/ssim.h"
#include "torch_api.h"

namespace gsf {

constexpr int64_t kSsimMaxChannels = 32;
constexpr int64_t kSsimMaxSide = 32768;

template <class Backend>
struct SsimOps {
  static int64_t check_images(const char* op, const Tensor& image, const Tensor& target,
                              bool inside) {
    check_shape(op, "image", image, {-1, -1, -1});
    check_shape(op, "target", target, {image.size(0), image.size(1), image.size(2)});
    check_dtype(op, "target", target, image.scalar_type());
    check_same_device(op, "target", target, image);
    const int64_t shortest = inside ? kSsimWindow : 1;
    for (int64_t side : {image.size(0), image.size(1)})
      STD_TORCH_CHECK(side >= shortest && side <= kSsimMaxSide, op, ": sides must lie in ",
                      shortest, "..", kSsimMaxSide, ", got ", shape_string(image));
    STD_TORCH_CHECK(image.size(2) >= 1 && image.size(2) <= kSsimMaxChannels, op,
                    ": images must have 1 to ", kSsimMaxChannels, " channels, got ",
                    shape_string(image));
    return inside ? kSsimRadius : 0;
  }

  template <typename T>
  static SsimArgs<T> images(const Tensor& image, const Tensor& target, int64_t inset) {
    SsimArgs<T> a{};
    a.height = image.size(0);
    a.width = image.size(1);
    a.channels = image.size(2);
    a.inset = inset;
    a.image = cptr<T>(image);
    a.target = cptr<T>(target);
    return a;
  }

  static Tensor ssim(const Tensor& image_in, const Tensor& target_in, bool inside) {
    const char* op = "ssim";
    const int64_t inset = check_images(op, image_in, target_in, inside);
    const Tensor image = gsf::contiguous(image_in), target = gsf::contiguous(target_in);
    Tensor out =
        gsf::new_empty(image, {image.size(0) - 2 * inset, image.size(1) - 2 * inset, image.size(2)},
                       image.scalar_type());
    const typename Backend::Scope scope(image);
    dispatch_floating(op, image, [&]<typename T>() {
      SsimArgs<T> a = images<T>(image, target, inset);
      a.map = mptr<T>(out);
      Backend::run(a, scope);
    });
    return out;
  }

  // Gradient with respect to `image` of the map's sum weighted by `grad`.
  static Tensor ssim_backward(const Tensor& grad_in, const Tensor& image_in,
                              const Tensor& target_in, bool inside) {
    const char* op = "ssim_backward";
    const int64_t inset = check_images(op, image_in, target_in, inside);
    const Tensor image = gsf::contiguous(image_in), target = gsf::contiguous(target_in);
    const Tensor grad =
        ready(op, "grad", grad_in, image,
              {image.size(0) - 2 * inset, image.size(1) - 2 * inset, image.size(2)});
    Tensor out =
        gsf::new_empty(image, {image.size(0), image.size(1), image.size(2)}, image.scalar_type());
    const typename Backend::Scope scope(image);
    dispatch_floating(op, image, [&]<typename T>() {
      SsimArgs<T> a = images<T>(image, target, inset);
      a.map_slope = cptr<T>(grad);
      a.grad_image = mptr<T>(out);
      Backend::run(a, scope);
    });
    return out;
  }

  // Loss, its figures (similarity, |miss|, miss^2, |excess|), gradients of image and alpha.
  static std::tuple<Tensor, Tensor, Tensor, Tensor> photometric_loss(
      const Tensor& image_in, const Tensor& target_in, const OptTensor& valid,
      const OptTensor& alpha, const OptTensor& mask, const OptTensor& backdrop, double constant,
      double l1, double similarity, double excess, bool inside, bool pixels, bool gradient) {
    const char* op = "photometric_loss";
    const int64_t inset = check_images(op, image_in, target_in, inside);
    STD_TORCH_CHECK(alpha.has_value() == mask.has_value(), op, ": alpha and mask go together");
    STD_TORCH_CHECK(!backdrop.has_value() || alpha.has_value(), op, ": backdrop needs alpha");
    const Tensor image = gsf::contiguous(image_in), target = gsf::contiguous(target_in);
    const int64_t h = image.size(0), w = image.size(1), channels = image.size(2);
    const OptTensor valid_c = ready(op, "valid", valid, image, {h, w});
    const OptTensor alpha_c = ready(op, "alpha", alpha, image, {h, w});
    const OptTensor mask_c = ready(op, "mask", mask, image, {h, w});
    const OptTensor backdrop_c = ready(op, "backdrop", backdrop, image, {channels});
    const auto dtype = image.scalar_type();
    Tensor loss = gsf::new_empty(image, {}, dtype);
    Tensor figures = gsf::new_empty(image, {kSsimSums}, dtype);
    const bool slopes_alpha = gradient && alpha_c.has_value();
    Tensor grad_image = gradient ? gsf::new_empty(image, {h, w, channels}, dtype)
                                 : gsf::new_empty(image, {0, w, channels}, dtype);
    Tensor grad_alpha = gsf::new_empty(image, {slopes_alpha ? h : 0, w}, dtype);
    const typename Backend::Scope scope(image);
    dispatch_floating(op, image, [&]<typename T>() {
      SsimArgs<T> a = images<T>(image, target, inset);
      a.valid = cptr<T>(valid_c);
      a.alpha = cptr<T>(alpha_c);
      a.mask = cptr<T>(mask_c);
      a.backdrop = cptr<T>(backdrop_c);
      a.weigh({constant, l1, similarity, excess});
      a.pixels = pixels;
      a.grad_image = gradient ? mptr<T>(grad_image) : nullptr;
      a.grad_alpha = slopes_alpha ? mptr<T>(grad_alpha) : nullptr;
      a.loss = mptr<T>(loss);
      a.figures = mptr<T>(figures);
      Backend::run(a, scope);
    });
    return {loss, figures, grad_image, grad_alpha};
  }

  static void register_all(Library& m) {
    GSF_IMPL(SsimOps, ssim);
    GSF_IMPL(SsimOps, ssim_backward);
    GSF_IMPL(SsimOps, photometric_loss);
  }
};

}  // namespace gsf
