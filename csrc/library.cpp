// Every operator schema, in reading order. Kernels are registered in the .cpp files of csrc/cpu and
// in the ops.cpp of each family in csrc/cuda.
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
      "transfer_slope(Tensor grid, Tensor constant, Tensor linear, Tensor position, Tensor? body, "
      "Tensor table, Tensor coords, Tensor order, Tensor start, int[3] origin, int margin, "
      "float dx) -> Tensor");
  m.def(
      "grid_update(Tensor grid, Tensor? moments, Tensor? colliders, Tensor? sdf, "
      "Tensor? merged, Tensor? cut, Tensor table, Tensor coords, int[3] origin, float dx, float "
      "dt, float "
      "gravity_x, float gravity_y, float gravity_z, float friction, "
      "float restitution, float contact_gap) -> "
      "(Tensor velocity, Tensor impulse, Tensor contact_mass, Tensor contact_nodes)");
  m.def(
      "g2p(Tensor velocity_grid, Tensor position, Tensor? velocity, Tensor? deformation, "
      "Tensor? body, Tensor table, Tensor coords, Tensor order, Tensor start, int[3] origin, "
      "int margin, float dx, float dt) -> (Tensor position, Tensor velocity, Tensor affine, "
      "Tensor deformation, Tensor skipped)");

  // --- collider: rigid bodies as rows ---
  m.def(
      "collider_distance(Tensor position, Tensor colliders, Tensor? sdf) -> "
      "(Tensor distance, Tensor normal)");
  m.def(
      "advance_colliders(Tensor colliders, Tensor impulse, float dt, float gravity_x, "
      "float gravity_y, float gravity_z) -> Tensor");
  // --- solver: the resident state of a simulation (gsfluent/ops/solver.py), advanced in place ---
  m.def("solver_prime(Tensor(a!)[] buffers, int[] ints, float[] floats) -> ()");
  m.def(
      "solver_run(Tensor(a!)[] buffers, int[] ints, float[] floats, int rounds, int steps) -> ()");
  m.def("solver_ranks(Tensor[] buffers, int[] ints, float[] floats) -> Tensor");
  m.def(
      "solver_prime_ranks(Tensor(a!)[] buffers, Tensor(b!)[] parts, int[] ints, float[] floats) "
      "-> ()");
  m.def(
      "solver_run_ranks(Tensor(a!)[] buffers, Tensor(b!)[] parts, int[] ints, float[] floats, "
      "int rounds, int steps) -> ()");

  m.def("blade_sides(Tensor position, Tensor blades, Tensor cut, float reach) -> Tensor");

  // --- plasticity: constitutive update on strain e = b - I ---
  m.def(
      "return_mapping(Tensor strain, Tensor alpha, Tensor increment, Tensor law, Tensor params, "
      "Tensor? material, float k, float epsilon, bool implicit, float dt=0.0, "
      "bool apart=True) -> (Tensor, Tensor, Tensor, Tensor)");
  m.def("neo_hookean_energy(Tensor strain, Tensor params, Tensor? material) -> Tensor");
  m.def(
      "softening_paths(Tensor params, Tensor alpha, Tensor stretch, Tensor first, int steps) -> "
      "(Tensor, Tensor)");
  // Gradients of strain, alpha, increment, of six material columns per particle, and 1 where they
  // were computed (laws elastic and nacc, no guard).
  m.def(
      "return_mapping_adjoint(Tensor grad_strain, Tensor grad_alpha, Tensor grad_stress, "
      "Tensor new_alpha, Tensor strain, Tensor alpha, Tensor increment, Tensor law, Tensor params, "
      "Tensor? material, float k, float epsilon, bool implicit) -> "
      "(Tensor, Tensor, Tensor, Tensor, Tensor)");

  // --- deform: polar decomposition, clamped deformation ---
  m.def("polar_clamped(Tensor deformation, float lo, float hi) -> (Tensor, Tensor)");
  m.def("covariance_axes(Tensor covariance) -> (Tensor, Tensor)");
  m.def(
      "carry_place(Tensor places, Tensor owner, Tensor near, Tensor parted, Tensor rest, "
      "Tensor position, Tensor map, Tensor width) -> (Tensor, Tensor)");
  m.def(
      "carry_axes(Tensor quats, Tensor scales, Tensor map, Tensor rotation, float rigid) -> "
      "(Tensor, Tensor)");
  m.def("quats_to_matrices(Tensor quats) -> Tensor");
  m.def("matrices_to_quats(Tensor matrices) -> Tensor");
  m.def("quat_products(Tensor left, Tensor right) -> Tensor");
  m.def(
      "link_states(Tensor position, Tensor apart, Tensor near, Tensor piece, Tensor? broken, "
      "Tensor? parted_before, Tensor? opened_before, Tensor none, float together, float loose, "
      "float open, float back) -> (Tensor parted, Tensor opened, Tensor ratio)");
  m.def(
      "find_faces(Tensor rows, Tensor means, Tensor owner, Tensor pitch, Tensor outward, "
      "Tensor depth, Tensor near, Tensor opened, Tensor rest, float[] fit) -> Tensor");
  m.def(
      "face_elements(Tensor rows, Tensor column, Tensor means, Tensor owner, Tensor pitch, "
      "Tensor outward, Tensor depth, Tensor near, Tensor opened, Tensor rest, float[] fit) -> "
      "(Tensor rival, Tensor means, Tensor quats, Tensor scales, Tensor normals)");
  m.def(
      "cut_at_cells(Tensor means, Tensor quats, Tensor scales, Tensor owner, Tensor near, "
      "Tensor opened, Tensor rest, float slack) -> (Tensor, Tensor, Tensor, Tensor)");
  m.def(
      "cut_by_planes(Tensor means, Tensor whole, Tensor covariance, Tensor first, Tensor normal, "
      "Tensor distance, Tensor share) -> (Tensor, Tensor, Tensor)");

  // --- mvee: minimum-volume enclosing ellipsoids ---
  m.def("mvee(Tensor points, float tolerance, int max_iterations) -> (Tensor, Tensor)");
  m.def(
      "mvee_lens(Tensor mean_a, Tensor covariance_a, Tensor mean_b, Tensor covariance_b, float "
      "radius, float flat) -> (Tensor, Tensor, Tensor, Tensor)");

  // --- raster: Gaussian splatting ---
  // Returns image, alpha, depth, median depth, normal, contribution, radii, then what the adjoint
  // needs: splats, order, tile_start, instances. `deterministic` is the adjoint's.
  m.def(
      "rasterize(Tensor means, Tensor opacities, Tensor viewmat, Tensor K, Tensor? quats, "
      "Tensor? scales, Tensor? covars, Tensor? sh, Tensor? colors, Tensor? background, "
      "Tensor? normals, Tensor? groups, Tensor? means2d_offset, Tensor? means2d_absgrad, "
      "int width, int height, bool antialiased, bool contribution, bool depth, "
      "bool median_depth, float near, float far, bool deterministic=False) -> (Tensor, Tensor, "
      "Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor)");
  // Gradients of means, opacities, quats, scales, covars, sh, colors, background, normals,
  // means2d_offset, means2d_absgrad.
  m.def(
      "rasterize_backward(Tensor? grad_image, Tensor? grad_alpha, Tensor? grad_depth, "
      "Tensor? grad_normal, Tensor image, Tensor alpha, Tensor depth, Tensor normal, "
      "Tensor splats, Tensor order, Tensor tile_start, Tensor instances, Tensor means, "
      "Tensor opacities, Tensor viewmat, Tensor K, Tensor? quats, Tensor? scales, Tensor? covars, "
      "Tensor? sh, Tensor? colors, Tensor? background, Tensor? normals, Tensor? groups, "
      "Tensor? means2d_offset, Tensor? means2d_absgrad, int width, int height, bool antialiased, "
      "bool depth, float near, float far, bool deterministic=False) -> (Tensor, Tensor, Tensor, "
      "Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor)");

  // --- density: occupancy of space by splats, and normals from its gradient ---
  m.def("splat_bulk(Tensor means, Tensor scales) -> Tensor");
  m.def("occupancy(Tensor means, Tensor frame, int nodes, float full) -> Tensor");
  m.def(
      "density_normals(Tensor means, Tensor quats, Tensor scales, Tensor values, Tensor frame, "
      "int nodes, Tensor? eye=None) -> Tensor");

  // --- spatial: labels of voxels, the largest of many fields, the nearest points, sums
  // over boxes of voxels, noise ---
  m.def("nearest_labels(Tensor place, Tensor rank, int[3] shape, float radius) -> Tensor");
  m.def(
      "largest_shares(Tensor? place, int[3] shape, Tensor shares, Tensor box) -> "
      "(Tensor, Tensor, Tensor)");
  m.def(
      "nearest_points(Tensor points, Tensor queries, Tensor? group, Tensor? asked, float cell, "
      "float reach, int count) -> (Tensor, Tensor)");
  m.def("box_blur(Tensor indicator, int width, int times) -> Tensor");
  m.def("distance_transform(Tensor occupied, bool indices) -> (Tensor, Tensor)");
  m.def("trilinear(Tensor grid, Tensor place) -> Tensor");
  m.def("value_noise(Tensor voxels, float[] spacings, float[] shifts, float[] weights) -> Tensor");
  m.def("hashes(Tensor seed, int[] turns) -> Tensor");
  m.def("label_boxes(Tensor labels, int count) -> Tensor");
  m.def(
      "margin_counts(Tensor lead, Tensor first, Tensor second, Tensor offset, float width) -> "
      "Tensor");

  // --- graph: links between points, what hangs together, the nearest seed along links ---
  m.def(
      "link_costs(Tensor links, Tensor length, Tensor spacing, Tensor position, Tensor broken, "
      "Tensor flowing, Tensor may_break, Tensor? gone, Tensor before, float open, float torn, "
      "float steep, float unit, int shift) -> (Tensor, Tensor, Tensor)");
  m.def("components(Tensor links, int count, Tensor? apart, Tensor? inside) -> Tensor");
  m.def("nearest_seeds(Tensor links, Tensor cost, Tensor key, Tensor other) -> Tensor");

  // --- texture: quantiles of many distributions, and votes of patches ---
  m.def("rows_between(Tensor ordered, Tensor low, Tensor high, Tensor share) -> Tensor");
  m.def("quantile_shift(Tensor values, Tensor have, Tensor want) -> Tensor");
  m.def(
      "patch_votes(Tensor center, Tensor offset, Tensor best, Tensor patches, Tensor weight, "
      "Tensor falloff, Tensor(a!) total, Tensor(b!) share) -> ()");

  // --- shade: light per pixel, from what the rasterizer blended to display values ---
  m.def(
      "shade(Tensor image, Tensor alpha, Tensor depth, Tensor normal, Tensor? gloss, "
      "Tensor viewmat, Tensor K, Tensor lamps, Tensor environment, Tensor background, "
      "Tensor? map_depth, Tensor? map_alpha, Tensor? map_cameras, Tensor? occupancy, "
      "Tensor? grid_frame, int nodes, float occlusion, Tensor? studio) -> Tensor");

  // --- ssim: structural similarity, the photometric loss of training ---
  m.def("ssim(Tensor image, Tensor target, bool inside) -> Tensor");
  m.def("ssim_backward(Tensor grad, Tensor image, Tensor target, bool inside) -> Tensor");
  // Returns the loss, its figures (similarity, |miss|, miss^2, |excess|: csrc/core/train/ssim.h),
  // and the gradients of image and alpha.
  m.def(
      "photometric_loss(Tensor image, Tensor target, Tensor? valid, Tensor? alpha, Tensor? mask, "
      "Tensor? backdrop, float constant, float l1, float ssim, float excess, bool inside, "
      "bool pixels, bool gradient) -> (Tensor, Tensor, Tensor, Tensor)");

  // --- adam: one optimiser step over several tensors, in place ---
  m.def(
      "adam_step(Tensor(a!)[] parameters, Tensor[] gradients, Tensor(b!)[] first, "
      "Tensor(c!)[] second, float[] rates, float beta1, float beta2, float epsilon, int step, "
      "Tensor? visible) -> ()");

  // --- activation: what a training changes, and what the rasterizer takes ---
  m.def(
      "activate(Tensor scales, Tensor opacities, Tensor sh0, Tensor sh_rest, int degree) -> "
      "(Tensor, Tensor, Tensor)");
  m.def(
      "activate_backward(Tensor scales, Tensor opacities, Tensor grad_scales, "
      "Tensor grad_opacities, Tensor grad_sh, int columns, int rest, float size, float needle, "
      "float aspect, float opacity, Tensor(a!)? mark) -> (Tensor, Tensor, Tensor, Tensor)");
  m.def("clamp_aspect(Tensor(a!) scales, float most) -> ()");
  m.def(
      "shorten_axes(Tensor means, Tensor quats, Tensor scales, Tensor opacities, Tensor away, "
      "float[] origin, float voxel, float overhang) -> Tensor");

  // --- build information ---
  m.def("compiled_for(Tensor like) -> str");
}
