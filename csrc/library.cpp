// Every operator schema, in reading order. Kernels are registered in csrc/cpu/*.cpp and
// csrc/cuda/*_ops.cpp.
#include "torch_api.h"

STABLE_TORCH_LIBRARY(gsfluent, m) {
  // --- mpm: sparse grid, particle-grid transfers, grid momentum update ---

  // --- plasticity: constitutive update on strain e = b - I ---
  m.def(
      "return_mapping(Tensor strain, Tensor alpha, Tensor increment, Tensor law, Tensor params, "
      "Tensor? material, float k, float epsilon, bool implicit) -> (Tensor, Tensor, Tensor, "
      "Tensor)");

  // --- deform: polar decomposition, clamped deformation ---
  m.def("polar_clamped(Tensor deformation, float lo, float hi) -> (Tensor, Tensor)");

  // --- mvee: minimum-volume enclosing ellipsoids ---

  // --- raster: Gaussian splatting ---

  // --- build information ---
  m.def("compiled_for(Tensor like) -> str");
}
