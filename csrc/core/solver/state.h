// State of the resident MPM solver: what stays on the device between steps, as plain pointers.
//
// Particles are stored grouped by home: the 4^3-cell block that held the base node of their stencil
// when the blocks were last built, together with their field (velocity field = body or fragment).
// The stencil of a particle may wander one node out of its home before the blocks are built anew;
// the window of a home is therefore 8^3 nodes, from node 4 B - 1 to node 4 B + 6 of block B.
//
//   position of a particle = (4 B - 1 + l + 1/2 + o) dx,   l in 0..5 per axis, o in [0, 1)
//
// so that neither distance from the origin nor a small step costs digits. Node values live in slots
// (one 4^3 block of one field); blocks that hold several fields have several slots, tied together
// by a site.
#pragma once

#include <cstdint>

#include "core/collider/blade.h"
#include "core/material/nacc.h"
#include "core/mpm/contact.h"

namespace gsf {

constexpr int kWindowEdge = 8;
constexpr int kWindowNodes = 512;
constexpr int kNeighbours = 27;  // blocks a window can touch
constexpr int kImpulseSums = 7;
constexpr int kLastCell = 5;     // largest l
constexpr int kRowColumns = 12;  // eight material parameters, then those below
constexpr int kMassColumn = 8;
constexpr int kPaceColumn = 9;  // of unloading: kSlowUnloading rho c dx
constexpr int kInverseDensityColumn = 10;
constexpr int kStressColumn = 11;  // 4 V0 / dx^2
constexpr int kSiteFields = 16;    // fields that may share one block
constexpr int kFieldBits = 12;     // fields of a scene
constexpr int kMaxSolverFields = (1 << kFieldBits) - 1;
constexpr int kBlockBits = 17;  // block coordinates lie in [-2^16, 2^16)
constexpr int32_t kBlockRange = 1 << (kBlockBits - 1);
constexpr int kMostRanks = 64;
constexpr int32_t kMostOfHome = 1 << 26;  // points of a home whose sums fit (solver-sums.md)
constexpr uint64_t kNoKey = ~uint64_t(0);

// l and the material row of a particle in one word.
GSF_HOST_DEVICE uint32_t pack_meta(int lx, int ly, int lz, uint32_t row) {
  return uint32_t(lx) | uint32_t(ly) << 3 | uint32_t(lz) << 6 | row << 9;
}
GSF_HOST_DEVICE int meta_cell(uint32_t meta, int axis) { return int(meta >> (3 * axis) & 7u); }
GSF_HOST_DEVICE uint32_t meta_row(uint32_t meta) { return meta >> 9; }

// Key of a block of a field in the hash table; field kMaxSolverFields stands for the site.
GSF_HOST_DEVICE uint64_t block_key(int32_t x, int32_t y, int32_t z, int32_t field) {
  const uint64_t mask = (uint64_t(1) << kBlockBits) - 1;
  return (uint64_t(uint32_t(x + kBlockRange)) & mask) << (2 * kBlockBits + kFieldBits) |
         (uint64_t(uint32_t(y + kBlockRange)) & mask) << (kBlockBits + kFieldBits) |
         (uint64_t(uint32_t(z + kBlockRange)) & mask) << kFieldBits | uint64_t(uint32_t(field));
}
GSF_HOST_DEVICE int32_t key_block(uint64_t key, int axis) {
  const uint64_t mask = (uint64_t(1) << kBlockBits) - 1;
  return int32_t(key >> ((2 - axis) * kBlockBits + kFieldBits) & mask) - kBlockRange;
}
GSF_HOST_DEVICE int32_t key_field(uint64_t key) {
  return int32_t(key & ((uint64_t(1) << kFieldBits) - 1));
}
GSF_HOST_DEVICE uint64_t hash_key(uint64_t k) {  // splitmix64 finaliser
  k = (k ^ (k >> 30)) * 0xbf58476d1ce4e5b9ull;
  k = (k ^ (k >> 27)) * 0x94d049bb133111ebull;
  return k ^ (k >> 31);
}

// Index of the neighbour block of window node i (0..7) along one axis: 0, 1, 2 for B - 1, B, B + 1.
GSF_HOST_DEVICE int window_block(int i) { return (i + 3) >> 2; }
GSF_HOST_DEVICE int window_local(int i) { return (i + 3) & 3; }

// Reach of a home, six bits: bit `axis` when its window touches block B - 1 on that axis, bit 3 +
// axis for B + 1. The blocks it needs are the whole box of these (an edge or corner block may be
// reached by a particle that was elsewhere in the home when the blocks were built). One particle,
// `local` = its cell in the block (0..3), with one cell of slack:
GSF_HOST_DEVICE uint32_t reach_of(int local_x, int local_y, int local_z) {
  return (local_x == 0 ? 1u : 8u) | (local_y == 0 ? 2u : 16u) | (local_z == 0 ? 4u : 32u);
}
// Whether neighbour n = (i, j, k) in {0, 1, 2}^3 is within reach.
GSF_HOST_DEVICE bool in_reach(uint32_t reach, int n) {
  const int step[3] = {n / 9, n / 3 % 3, n % 3};
  bool in = true;
  for (int axis = 0; axis < 3; ++axis)
    in = in && (step[axis] == 1 || (reach >> (step[axis] == 0 ? axis : 3 + axis) & 1u) != 0);
  return in;
}
// Reach of a home from its row of SolverView::neighbour (the six face blocks tell).
GSF_HOST_DEVICE uint32_t reach_of_row(const int32_t* neighbour) {
  return (neighbour[4] >= 0 ? 1u : 0u) | (neighbour[10] >= 0 ? 2u : 0u) |
         (neighbour[12] >= 0 ? 4u : 0u) | (neighbour[22] >= 0 ? 8u : 0u) |
         (neighbour[16] >= 0 ? 16u : 0u) | (neighbour[14] >= 0 ? 32u : 0u);
}
// Whether a particle at l on this axis stays on blocks within reach: nodes l to l + 2, of which
// block B holds 1 to 4.
GSF_HOST_DEVICE bool cell_in_reach(uint32_t reach, int axis, int l) {
  return (l >= 1 || (reach >> axis & 1u) != 0) && (l <= 2 || (reach >> (3 + axis) & 1u) != 0);
}

// Why the solver stopped before the end; 0 while all is well. Python words them (ops/solver.py).
enum SolverReason : int64_t {
  kFine = 0,
  kNotFinite = 1,     // a speed, wave speed or strain is not finite
  kTooFast = 2,       // a particle moved further than its window in one step
  kCrowded = 3,       // more than kSiteFields fields in one block
  kOutside = 4,       // a particle beyond the largest block coordinate
  kStepTooSmall = 5,  // the step fell below what time can resolve
  kFull = 6,          // more than kMostOfHome points in one home (CUDA)
};

// What one of several ranks on CUDA tells the others at the end of a step, from its clock; then
// what its colliders got (kImpulseSums each).
enum Mail : int {
  kMailSpeed,
  kMailWave,
  kMailGradient,
  kMailBound,
  kMailPlastic,
  kMailGuarded,
  kMailInverted,
  kMailInvalid,
  kMailTouched,
  kMailLost,
  kMailLeaving,
  kMailWords
};

// Everything about time and health that kernels read and write; every member is eight bytes, so
// that Python reads it as one int64 or float64 tensor.
struct SolverClock {
  double time, until, dt, dt_next;                  // 0..3  [s]
  double dt_fixed, dt_scale, cfl, gradient_limit;   // 4..7
  double momentum_unit, mass_unit, dt_min, dt_max;  // 8..11
  int64_t step, steps_left, done, rebuild;          // 12..15
  int64_t grow, reason, parity, homes;              // 16..19
  int64_t slots, sites, cursor, arrived;            // 20..23
  uint64_t speed, wave, gradient, bound;            // 24..27 bits of floats, largest of the step
  int64_t plastic, guarded, inverted, invalid;      // 28..31 sums over steps
  int64_t contact_nodes, contact_steps, builds, wanted_homes;  // 32..35
  int64_t wanted_slots, homes_max, slots_max, particle_steps;  // 36..39
  int64_t touched, lost, unit_bits, shared_sites;              // 40..43
  double speed_seen, wave_seen;                                // 44, 45
  int64_t leaving;                                             // 46
  double slack;                                                // 47 cells a point may move next
  double travel;         // 48 how far a collider may have moved since the last build [m]
  uint64_t moved;        // 49 bits: furthest a collider moved in this step
  double dt_most;        // 50 longest automatic step [s]
  int64_t shared_homes;  // 51 homes whose window touches shared blocks (CUDA)
  int64_t quiet;         // 52 rounds leave out the damage field, and end where it is wanted (CUDA)
};
constexpr int kClockWords = 53;
static_assert(sizeof(SolverClock) == 8 * kClockWords, "the clock is read word by word");

template <typename T>
struct HomeList {
  int32_t* coord;  // [H, 4] block and field
  int32_t* start;  // [H]
  int32_t* count;  // [H]
};

template <typename T>
struct SolverView {
  int64_t count;  // points there is room for, the stride of their planes: all of the scene, or of
                  // several ranks on CUDA those that one may have (none: the view of all, while its
                  // points lie with the ranks)
  int64_t total;  // points of the scene
  int64_t home_capacity, slot_capacity, table_size, row_count, collider_count;
  int32_t fields;
  int32_t ranks;  // parts of the scene: on a CPU in cpu/ranks, on devices in cuda/ranks
  int32_t rank;   // CUDA, several ranks: which of them this is; `ranks` is the view of all
  T dx, inv_dx;
  T gravity[3];
  ContactLaw contact;
  NaccOptions<T> options;
  bool irreversible;
  SolverClock* clock;
  // particles, grouped by home (N = count); shapes as on the CPU, see core/solver/layout.h
  T* offset;       // [N, 3] o
  uint32_t* meta;  // [N]
  T* velocity;     // [N, 3] m/s
  T* slope;        // [N, 3, 3] m C - dt V0 (4 / dx^2) tau with the dt of the coming step; kg/s
  T* strain;       // [N, 6] e = b - I
  T* alpha;        // [N] or null when no law uses it
  T* peak;         // [N] largest alpha so far, or null
  T* deformation;  // [N, 3, 3] total deformation gradient, or null
  int32_t* id;     // [N] row of the particle when it was loaded
  T* spare;        // [N, 9] scratch of the re-sort
  int32_t* entry;  // [N] scratch; between builds, on CUDA: the homes that touch shared blocks
  int32_t* place;  // [N] scratch; between builds, on CUDA: whether home h touches shared blocks
  // materials
  const int32_t* law;  // [rows]
  const T* rows;       // [rows, kRowColumns]
  // blocks
  HomeList<T> home[2];   // the one in use is clock->parity
  int32_t* neighbour;    // [H, 27] slots under the window, -1 for none
  T* home_bound;         // [H] largest momentum one particle can give to one node [kg m/s]
  T* home_mass;          // [H] largest particle mass [kg]
  int32_t* slot_coord;   // [S, 4] block and field
  int32_t* slot_shared;  // [S] 1: its site holds several fields (CPU: that part); 2 (CUDA): next to
                         // such; 0
  int32_t* site_slots;   // [S, kSiteFields] slots of a site in ascending field, -1 after the last
  void* sums;            // [S, 64, 4] momentum and mass: int64 units on CUDA, double on the CPU
  // [S, 64, kContactMoments], where slot_shared: int64 units on CUDA, T on the CPU; null: one field
  void* moments;
  T* node_velocity;  // [S, 64, 4]
  // hash table
  uint64_t* key;         // [table_size]
  int32_t* table_count;  // [table_size] particles of a home
  int32_t* table_mask;   // [table_size] neighbours a home reaches; then the shared sites (CUDA)
  int32_t* table_home;   // [table_size]
  int32_t* table_slot;   // [table_size] slot, or head of the slot list of a site
  int32_t* slot_next;    // [S] chain of the slots of a site
  uint64_t* slot_near;   // [S] colliders that can touch the block before the next build, as bits
  // colliders
  T* colliders;            // [K, kColliderColumns] as nodes see them
  double* collider_state;  // [K, kColliderColumns] as they move
  const float* sdf;        // distance grids, or null
  int64_t sdf_count;
  int64_t* impulse_units;  // [K, kImpulseSums] of this step, in units (CUDA)
  double* impulse;  // [K, kImpulseSums] impulse [N s] and torque [N m s] since the load, then
                    // the mass touched in the last step [kg]
  // blades: fields of one body move as one, except on opposite sides of a blade; or null: no blade
  const int32_t* parent;  // [fields] body of each field
  const int32_t* cut;     // [fields] its sides (core/collider/blade.h)
  // [total, 2] contact radius of each point by its row when it was loaded (core/collider/spring.h)
  // [m], and the share of its pushes that it gets while it parts; or null: colliders hold nodes
  const T* radius;
  // [N, 9] viscosity of each point (core/material/viscous.h), or null
  T* viscous;
  // [fields] object of each field: points of different ones push each other
  // (core/collider/touch.h); or null: fields meet at nodes
  const int32_t* object;
  // [N, 9] m C of each point without the stress that `slope` holds [kg/s], and the shares of their
  // own motion that points keep in a step (leave_share): of velocity, and of m C and its transpose;
  // or null and 0
  T* own;
  T kept_speed, kept_slope, kept_across;
  // of scenes with one of these three, on CUDA: node velocities of the pass without forces; volume
  // [cells] and stiffness [Pa] of the points of each row, the fastest P-wave and the largest
  // stiffness, and the largest that colliders and other points give to a point in this step, as
  // bits; what they give to the points about a node, in units
  T* free_velocity;     // [S, 64, 4]
  double* spring_rows;  // [rows + 2, 2]
  int64_t* push;        // [S, 64, 4]
  int64_t* press;       // [S, 64, 4]
  int32_t* slot_given;  // [S] whether any of that is not 0: bit 0 of push, bit 1 of press
  // of several ranks, on CUDA (cuda/ranks/ranks.h)
  const SolverView<T>* peers;  // [ranks + 1] views of the ranks and of all; null: one rank
  int32_t* home_rank;          // [H] of all: the rank that owns each home,
  int32_t* home_place;         // [H] and the first of its points there
  uint64_t* holders;           // [S] ranks that hold the sums of each slot, as bits
  uint64_t* needers;           // [S] those of them that need its velocities
  int64_t* mail;               // [kMailWords + K * kImpulseSums] what a rank tells the others
  // of phase-field matter, on CUDA (cuda/solver/damage.cu); or null
  int64_t* damage_sums;    // [S, 64, 4] in units (core/solver/damage.h)
  double* damage_nodes;    // [S, 64, 4] DamageNode
  int32_t* damage_slots;   // [kDamagePlanes, S]
  int32_t* damage_homes;   // [H] homes that meet slots that take part
  int32_t* damage_counts;  // [4] slots of points to solve for, slots that take part, such homes,
                           // homes that are taken
  double* damage_scale;    // [7] units of the sums, 1 of AT2, volume of an empty node,
                           // stiffness over volume of matter of one length, or 0

  // Whether this rank answers for a slot: counts its contacts, books its impulses. The first does
  // that needs its velocities.
  GSF_HOST_DEVICE bool needs(int64_t slot) const {
    return peers == nullptr || (needers[slot] >> rank & 1u) != 0;
  }
  GSF_HOST_DEVICE bool answers(int64_t slot) const {
    return peers == nullptr || (needers[slot] & ((uint64_t(2) << rank) - 1)) == uint64_t(1) << rank;
  }
  // Row of the particle with this meta word; garbage rows count as the first.
  GSF_HOST_DEVICE uint32_t row_of(uint32_t meta) const {
    return meta_row(meta) < uint64_t(row_count) ? meta_row(meta) : 0;
  }
  GSF_HOST_DEVICE int32_t cut_of(int32_t field) const { return cut != nullptr ? cut[field] : 0; }
  GSF_HOST_DEVICE bool moves_with(int32_t a, int32_t b) const {
    return parent != nullptr && parent[a] == parent[b] && !cut_apart(cut[a], cut[b]);
  }
  GSF_HOST_DEVICE bool touches_by_points(int32_t a, int32_t b) const {
    return object != nullptr && uint32_t(a) < uint32_t(fields) && uint32_t(b) < uint32_t(fields) &&
           object[a] != object[b];
  }
  GSF_HOST_DEVICE const HomeList<T>& homes() const { return home[clock->parity & 1]; }
  GSF_HOST_DEVICE const HomeList<T>& next_homes() const { return home[1 - (clock->parity & 1)]; }
};

// Bits of the place of a point on its rank in a word whose bits above it name that rank (CUDA).
GSF_HOST_DEVICE int place_bits(int32_t ranks) {
  int bits = 32;
  for (int32_t most = ranks - 1; most > 0; most >>= 1) --bits;
  return bits < 31 ? bits : 31;
}

// True while a step may run: nothing has ended, failed or asked for new blocks.
GSF_HOST_DEVICE bool may_step(const SolverClock& c) {
  return (c.done | c.rebuild | c.grow | c.reason) == 0;  // four loads at once
}
GSF_HOST_DEVICE bool may_build(const SolverClock& c) {
  return (c.done | c.grow | c.reason) == 0 && c.rebuild != 0;
}
// Whether rounds without the damage field have come to points that it is to be solved for.
template <typename T>
GSF_HOST_DEVICE bool wants_damage(const SolverView<T>& s) {
  return s.clock->quiet != 0 && s.damage_counts[0] != 0;
}

}  // namespace gsf
