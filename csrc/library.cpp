// Every operator schema, in reading order. Kernels are registered in csrc/cpu/*.cpp and
// csrc/cuda/*_ops.cpp.
#include "torch_api.h"

STABLE_TORCH_LIBRARY(gsfluent, m) {
  // --- mpm: sparse grid, particle-grid transfers, grid momentum update ---
  m.def(
      "build_blocks(Tensor position, float dx, int margin, int max_table) -> "
      "(Tensor table, Tensor coords, Tensor order, Tensor start, Tensor info)");
  m.def(
      "p2g(Tensor position, Tensor velocity, Tensor affine, Tensor mass, Tensor? stress, "
      "Tensor? volume, Tensor? body, Tensor table, Tensor coords, Tensor order, Tensor start, "
      "int[3] origin, int margin, float dx, float dt, int fields, bool contact) -> "
      "(Tensor grid, Tensor moments, Tensor skipped)");
  m.def(
      "p2g_adjoint(Tensor grid, Tensor position, Tensor? body, Tensor table, Tensor coords, "
      "Tensor order, Tensor start, int[3] origin, int margin, float dx) -> "
      "(Tensor value, Tensor first)");
  m.def(
      "grid_update(Tensor grid, Tensor? moments, Tensor? colliders, Tensor coords, float dx, "
      "float dt, float gravity_x, float gravity_y, float gravity_z, float friction, "
      "float restitution, float contact_gap) -> "
      "(Tensor velocity, Tensor impulse, Tensor contact_nodes)");
  m.def(
      "g2p(Tensor velocity_grid, Tensor position, Tensor? velocity, Tensor? deformation, "
      "Tensor? body, Tensor table, Tensor coords, Tensor order, Tensor start, int[3] origin, "
      "int margin, float dx, float dt) -> (Tensor position, Tensor velocity, Tensor affine, "
      "Tensor deformation, Tensor skipped)");

  // --- plasticity: constitutive update on strain e = b - I ---

  // --- deform: polar decomposition, clamped deformation ---

  // --- mvee: minimum-volume enclosing ellipsoids ---

  // --- raster: Gaussian splatting ---

  // --- build information ---
  m.def("compiled_for(Tensor like) -> str");
}
