// Every operator schema, in reading order. Kernels are registered in csrc/cpu/*.cpp and
// csrc/cuda/*_ops.cpp.
#include "torch_api.h"

STABLE_TORCH_LIBRARY(gsfluent, m) {
  // --- mpm: sparse grid, particle-grid transfers, grid momentum update ---

  // --- plasticity: constitutive update on strain e = b - I ---

  // --- deform: polar decomposition, clamped deformation ---
  m.def("polar_clamped(Tensor deformation, float lo, float hi) -> (Tensor, Tensor)");

  // --- mvee: minimum-volume enclosing ellipsoids ---

  // --- raster: Gaussian splatting ---
  // Returns image, alpha, depth, normal, contribution, radii, then what the adjoint needs: splats,
  // order, tile_start, instances.
  m.def(
      "rasterize(Tensor means, Tensor opacities, Tensor viewmat, Tensor K, Tensor? quats, "
      "Tensor? scales, Tensor? covars, Tensor? sh, Tensor? colors, Tensor? background, "
      "Tensor? normals, Tensor? groups, Tensor? means2d_offset, int width, int height, "
      "bool antialiased, bool contribution, float near, float far) -> "
      "(Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor)");
  // Gradients of means, opacities, quats, scales, covars, sh, colors, background, normals,
  // means2d_offset.
  m.def(
      "rasterize_backward(Tensor? grad_image, Tensor? grad_alpha, Tensor? grad_depth, "
      "Tensor? grad_normal, Tensor image, Tensor alpha, Tensor depth, Tensor normal, "
      "Tensor splats, Tensor order, Tensor tile_start, Tensor instances, Tensor means, "
      "Tensor opacities, Tensor viewmat, Tensor K, Tensor? quats, Tensor? scales, Tensor? covars, "
      "Tensor? sh, Tensor? colors, Tensor? background, Tensor? normals, Tensor? groups, "
      "Tensor? means2d_offset, int width, int height, bool antialiased, float near, float far) -> "
      "(Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor)");

  // --- build information ---
  m.def("compiled_for(Tensor like) -> str");
}
