// Checks and dtype dispatch of the resident solver, once for both back ends. The state is a list of
// tensors in the order of `SolverBuffer`; gsfluent/ops/solver_buffers.py allocates them by the same
// names. An empty tensor stands for a part the scene does not use.
#pragma once

#include <cmath>
#include <cstring>

#include "core/collider/collider.h"
#include "core/material/viscous.h"
#include "core/solver/damage.h"
#include "torch_api.h"

namespace gsf {

enum SolverBuffer : int {
  kClock,
  kOffset,
  kMeta,
  kVelocityBuffer,
  kSlope,
  kStrain,
  kAlpha,
  kPeak,
  kDeformation,
  kId,
  kSpare,
  kEntry,
  kPlace,
  kLaw,
  kRows,
  kHomeCoord0,
  kHomeStart0,
  kHomeCount0,
  kHomeCoord1,
  kHomeStart1,
  kHomeCount1,
  kNeighbour,
  kHomeBound,
  kHomeMass,
  kSlotCoord,
  kSlotShared,
  kSiteSlots,
  kSums,
  kMoments,
  kNodeVelocity,
  kKey,
  kTableCount,
  kTableMask,
  kTableHome,
  kTableSlot,
  kSlotNext,
  kSlotNear,
  kColliders,
  kColliderRows,
  kSdfBuffer,
  kImpulseUnits,
  kImpulse,
  kParent,
  kCut,
  kContactRadius,
  kViscous,
  kObject,
  kOwn,
  kFreeVelocity,
  kSpringRows,
  kPush,
  kPress,
  kSlotGiven,
  kHomeRank,
  kHomePlace,
  kHolders,
  kNeeders,
  kMail,
  kPeers,
  kDamageSumUnits,
  kDamageNodes,
  kDamageSlots,
  kDamageHomes,
  kDamageCounts,
  kDamageScale,
  kSolverBuffers
};

enum SolverFloat : int {
  kDx,
  kGravityX,
  kGravityY,
  kGravityZ,
  kFrictionBetween,
  kRestitutionBetween,
  kGap,
  kPower,
  kEpsilon,
  kFlip,
  kSolverFloats
};
constexpr int64_t kViewBytes = 1024;  // room for a view
static_assert(sizeof(SolverView<double>) <= kViewBytes);
enum SolverInt : int { kFields, kImplicit, kIrreversible, kLawSet, kRanks, kTotal, kSolverInts };

template <class Backend>
struct SolverOps {
  using Buffers = std::vector<Tensor>;

  static void check_rows(const char* name, const Tensor& t, int64_t rows, int64_t columns) {
    STD_TORCH_CHECK(t.numel() == 0 || t.numel() == rows * columns, "solver: ", name, " must hold ",
                    rows, " x ", columns, " values, got ", t.numel());
    STD_TORCH_CHECK(t.is_contiguous(), "solver: ", name, " must be contiguous");
  }

  template <typename T>
  static SolverView<T> view(const Buffers& b, const std::vector<int64_t>& ints,
                            const std::vector<double>& floats) {
    SolverView<T> s;
    // Every byte, also between members: back ends compare views to see whether anything moved.
    std::memset(static_cast<void*>(&s), 0, sizeof s);
    const Tensor& like = b[kOffset];
    s.count = b[kId].numel();
    s.total = ints[kTotal];
    s.home_capacity = b[kHomeStart0].size(0);
    s.slot_capacity = b[kSlotNext].size(0);
    s.table_size = b[kKey].size(0);
    s.row_count = b[kLaw].size(0);
    s.collider_count = b[kColliders].numel() / kColliderColumns;
    STD_TORCH_CHECK(s.table_size > 0 && (s.table_size & (s.table_size - 1)) == 0,
                    "solver: the hash table must have a power of two entries");
    const ScalarType real = like.scalar_type(), i32 = ScalarType::Int, i64 = ScalarType::Long;
    const bool device = like.is_cuda();
    const bool several = device && ints[kRanks] > 1;  // the view of all needs no scratch then
    const int64_t n = s.count, h = s.home_capacity, c = s.slot_capacity, t = s.table_size;
    const ScalarType sum = device ? i64 : ScalarType::Double, moment = device ? i64 : real;
    const struct {
      const char* name;
      int64_t rows, columns;
      ScalarType type;
      bool optional;
    } wanted[kSolverBuffers] = {
        {"clock", 1, kClockWords, i64, false},
        // core/solver/layout.h: on a device offset holds meta, and velocity the slope
        {"offset", n, device ? 4 : 3, real, false},
        {"meta", device ? 0 : n, 1, i32, false},
        {"velocity", n, device ? 12 : 3, real, false},
        {"slope", device ? 0 : n, 9, real, false},
        {"strain", n, 6, real, false},
        {"alpha", n, 1, real, true},
        {"peak", n, 1, real, true},
        {"deformation", n, 9, real, true},
        {"id", n, 1, i32, false},
        {"spare", n, 9, real, several},
        {"entry", n, 1, i32, several},
        {"place", n, 1, i32, several},
        {"law", s.row_count, 1, i32, false},
        {"rows", s.row_count, kRowColumns, real, false},
        {"home_coord0", h, 4, i32, false},
        {"home_start0", h, 1, i32, false},
        {"home_count0", h, 1, i32, false},
        {"home_coord1", h, 4, i32, false},
        {"home_start1", h, 1, i32, false},
        {"home_count1", h, 1, i32, false},
        {"neighbour", h, kNeighbours, i32, false},
        {"home_bound", h, 1, real, false},
        {"home_mass", h, 1, real, false},
        {"slot_coord", c, 4, i32, false},
        {"slot_shared", c, 1, i32, false},
        {"site_slots", c, kSiteFields, i32, false},
        {"sums", c * kBlockNodes, 4, sum, false},
        {"moments", c * kBlockNodes, kContactMoments, moment, true},
        {"node_velocity", c * kBlockNodes, 4, real, false},
        {"key", t, 1, i64, false},
        {"table_count", t, 1, i32, false},
        {"table_mask", t, 1, i32, false},
        {"table_home", t, 1, i32, false},
        {"table_slot", t, 1, i32, false},
        {"slot_next", c, 1, i32, false},
        {"slot_near", c, 1, i64, false},
        {"colliders", s.collider_count, kColliderColumns, real, true},
        {"collider_state", s.collider_count, kColliderColumns, ScalarType::Double, true},
        {"sdf", b[kSdfBuffer].numel(), 1, ScalarType::Float, true},
        {"impulse_units", s.collider_count, kImpulseSums, i64, true},
        {"impulse", s.collider_count, kImpulseSums, ScalarType::Double, true},
        {"parent", ints[kFields], 1, i32, true},
        {"cut", ints[kFields], 1, i32, true},
        {"radius", s.total, 2, real, true},
        {"viscous", n, kViscousColumns, real, true},
        {"object", ints[kFields], 1, i32, true},
        {"own", n, 9, real, true},
        {"free_velocity", c * kBlockNodes, 4, real, true},
        {"spring_rows", s.row_count + 2, 2, ScalarType::Double, true},
        {"push", c * kBlockNodes, 4, i64, true},
        {"press", c * kBlockNodes, 4, i64, true},
        {"slot_given", c, 1, i32, true},
        {"home_rank", h, 1, i32, true},
        {"home_place", h, 1, i32, true},
        {"holders", c, 1, i64, true},
        {"needers", c, 1, i64, true},
        {"mail", kMailWords + s.collider_count * kImpulseSums, 1, i64, true},
        {"peers", ints[kRanks] + 1, kViewBytes, ScalarType::Byte, true},
        {"damage_sums", c * kBlockNodes, kDamageSums, i64, true},
        {"damage_nodes", c * kBlockNodes, kDamageSums, ScalarType::Double, true},
        {"damage_slots", kDamagePlanes, c, i32, true},
        {"damage_homes", h, 1, i32, true},
        {"damage_counts", 4, 1, i32, true},
        {"damage_scale", kDamageScales, 1, ScalarType::Double, true},
    };
    for (int i = 0; i < kSolverBuffers; ++i) {
      check_rows(wanted[i].name, b[i], wanted[i].rows, wanted[i].columns);
      STD_TORCH_CHECK(b[i].scalar_type() == wanted[i].type, "solver: ", wanted[i].name,
                      " has the wrong dtype");
      STD_TORCH_CHECK(b[i].device() == like.device(), "solver: ", wanted[i].name,
                      " must be on the device of offset");
      STD_TORCH_CHECK(wanted[i].optional || b[i].numel() > 0 || wanted[i].rows == 0,
                      "solver: ", wanted[i].name, " must not be empty");
    }
    const auto real_at = [&](int i) { return b[i].numel() ? mptr<T>(b[i]) : nullptr; };
    const auto int_at = [&](int i) { return b[i].numel() ? mptr<int32_t>(b[i]) : nullptr; };
    const auto any_at = [&](int i) -> void* {
      return b[i].numel() ? b[i].mutable_data_ptr() : nullptr;
    };
    s.ranks = static_cast<int32_t>(ints[kRanks]);
    STD_TORCH_CHECK(ints[kRanks] >= 1 && ints[kRanks] <= kMostRanks, "solver: ranks must be 1 to ",
                    kMostRanks);
    s.fields = static_cast<int32_t>(ints[kFields]);
    STD_TORCH_CHECK(s.fields >= 1 && s.fields < kMaxSolverFields, "solver: fields must be 1 to ",
                    kMaxSolverFields - 1);
    STD_TORCH_CHECK(s.fields == 1 || b[kMoments].numel() > 0,
                    "solver: several fields need moments");
    STD_TORCH_CHECK(b[kColliderRows].numel() == b[kColliders].numel() &&
                        b[kImpulse].numel() == s.collider_count * kImpulseSums &&
                        b[kImpulseUnits].numel() == s.collider_count * kImpulseSums,
                    "solver: colliders, collider_state and impulse must have the same rows");
    STD_TORCH_CHECK(b[kParent].numel() == b[kCut].numel(),
                    "solver: parent and cut must have the same rows");
    const auto comes_with = [&](int part, int room) {
      STD_TORCH_CHECK(!device || b[part].numel() == 0 || b[room].numel() > 0,
                      "solver: ", wanted[part].name, " needs ", wanted[room].name, " on a device");
    };
    comes_with(kOwn, kFreeVelocity);
    comes_with(kContactRadius, kSpringRows);
    comes_with(kContactRadius, kPush);
    comes_with(kContactRadius, kSlotGiven);
    comes_with(kObject, kContactRadius);
    comes_with(kObject, kPress);
    for (int i = kDamageSumUnits; i < kDamageScale; ++i)
      STD_TORCH_CHECK(!device || !with_damage(ints[kLawSet]) || b[i].numel() > 0,
                      "solver: ", wanted[i].name, " is missing");
    const bool any_law = ints[kLawSet] != 0;
    STD_TORCH_CHECK(!any_law || (b[kAlpha].numel() == n && b[kPeak].numel() == n),
                    "solver: these laws need alpha and peak");
    s.dx = static_cast<T>(floats[kDx]);
    s.inv_dx = static_cast<T>(1.0 / floats[kDx]);
    for (int i = 0; i < 3; ++i) s.gravity[i] = static_cast<T>(floats[kGravityX + i]);
    s.contact = {floats[kFrictionBetween], floats[kRestitutionBetween], floats[kGap]};
    s.options = {static_cast<T>(floats[kPower]), static_cast<T>(floats[kEpsilon]),
                 ints[kImplicit] != 0};
    s.irreversible = ints[kIrreversible] != 0;
    s.clock = static_cast<SolverClock*>(any_at(kClock));
    s.offset = real_at(kOffset);
    s.meta = static_cast<uint32_t*>(any_at(kMeta));
    s.velocity = real_at(kVelocityBuffer);
    s.slope = real_at(kSlope);
    s.strain = real_at(kStrain);
    s.alpha = real_at(kAlpha);
    s.peak = real_at(kPeak);
    s.deformation = real_at(kDeformation);
    s.id = int_at(kId);
    s.spare = real_at(kSpare);
    s.entry = int_at(kEntry);
    s.place = int_at(kPlace);
    s.law = int_at(kLaw);
    s.rows = real_at(kRows);
    s.home[0] = {int_at(kHomeCoord0), int_at(kHomeStart0), int_at(kHomeCount0)};
    s.home[1] = {int_at(kHomeCoord1), int_at(kHomeStart1), int_at(kHomeCount1)};
    s.neighbour = int_at(kNeighbour);
    s.home_bound = real_at(kHomeBound);
    s.home_mass = real_at(kHomeMass);
    s.slot_coord = int_at(kSlotCoord);
    s.slot_shared = int_at(kSlotShared);
    s.site_slots = int_at(kSiteSlots);
    s.sums = any_at(kSums);
    s.moments = any_at(kMoments);
    s.node_velocity = real_at(kNodeVelocity);
    s.key = static_cast<uint64_t*>(any_at(kKey));
    s.table_count = int_at(kTableCount);
    s.table_mask = int_at(kTableMask);
    s.table_home = int_at(kTableHome);
    s.table_slot = int_at(kTableSlot);
    s.slot_next = int_at(kSlotNext);
    s.slot_near = static_cast<uint64_t*>(any_at(kSlotNear));
    s.colliders = real_at(kColliders);
    s.collider_state = static_cast<double*>(any_at(kColliderRows));
    s.sdf = static_cast<const float*>(any_at(kSdfBuffer));
    s.sdf_count = b[kSdfBuffer].numel();
    s.impulse_units = static_cast<int64_t*>(any_at(kImpulseUnits));
    s.impulse = static_cast<double*>(any_at(kImpulse));
    s.parent = int_at(kParent);
    s.cut = int_at(kCut);
    s.radius = real_at(kContactRadius);
    s.viscous = real_at(kViscous);
    s.object = int_at(kObject);
    s.own = real_at(kOwn);
    // velocity and spin keep the share itself, rates of strain its root (docs/theory/mpm.md)
    const double slow = floats[kFlip], fast = std::sqrt(slow);
    s.kept_speed = static_cast<T>(slow);
    s.kept_slope = static_cast<T>(0.5 * (fast + slow));
    s.kept_across = static_cast<T>(0.5 * (fast - slow));
    s.free_velocity = real_at(kFreeVelocity);
    s.spring_rows = static_cast<double*>(any_at(kSpringRows));
    s.push = static_cast<int64_t*>(any_at(kPush));
    s.press = static_cast<int64_t*>(any_at(kPress));
    s.slot_given = int_at(kSlotGiven);
    s.home_rank = int_at(kHomeRank);
    s.home_place = int_at(kHomePlace);
    s.holders = static_cast<uint64_t*>(any_at(kHolders));
    s.needers = static_cast<uint64_t*>(any_at(kNeeders));
    s.mail = static_cast<int64_t*>(any_at(kMail));
    s.peers = static_cast<const SolverView<T>*>(any_at(kPeers));
    s.damage_sums = static_cast<int64_t*>(any_at(kDamageSumUnits));
    s.damage_nodes = static_cast<double*>(any_at(kDamageNodes));
    s.damage_slots = int_at(kDamageSlots);
    s.damage_homes = int_at(kDamageHomes);
    s.damage_counts = int_at(kDamageCounts);
    s.damage_scale = static_cast<double*>(any_at(kDamageScale));
    return s;
  }

  // Starts the clock and takes the stress of the first step into the slopes.
  static void solver_prime(Buffers buffers, std::vector<int64_t> ints, std::vector<double> floats) {
    call(buffers, ints, floats,
         [&](auto view, const auto& scope) { Backend::prime(view, law_set(ints), scope); });
  }

  // Up to `rounds` rounds of `steps` steps, building blocks where needed; ends early when the clock
  // says so. On CUDA this returns at once: the clock holds the outcome.
  static void solver_run(Buffers buffers, std::vector<int64_t> ints, std::vector<double> floats,
                         int64_t rounds, int64_t steps) {
    STD_TORCH_CHECK(rounds >= 0 && steps > 0, "solver_run: rounds and steps must be positive");
    call(buffers, ints, floats, [&](auto view, const auto& scope) {
      Backend::run(view, law_set(ints), rounds, steps, scope);
    });
  }

  // What each rank holds since the last build, [ranks, 4]: points, homes, slots, and slots that
  // others hold too. CPU only.
  static Tensor solver_ranks(Buffers buffers, std::vector<int64_t> ints,
                             std::vector<double> floats) {
    std::vector<Tensor> out;
    call(buffers, ints, floats, [&](auto view, const auto&) {
      out.push_back(new_zeros(buffers[kClock], {view.ranks, 4}, ScalarType::Long));
      Backend::ranks(view, mptr<int64_t>(out[0]));
    });
    return out[0];
  }

  // Several ranks on CUDA: `parts` holds the buffers of each, one after the other, and `buffers`
  // those of all, which have no points. As solver_prime.
  static void solver_prime_ranks(Buffers buffers, Buffers parts, std::vector<int64_t> ints,
                                 std::vector<double> floats) {
    call_ranks(buffers, parts, ints, floats, [&](auto views, const Buffers& like) {
      Backend::prime_ranks(std::move(views), like, law_set(ints));
    });
  }
  // As solver_run.
  static void solver_run_ranks(Buffers buffers, Buffers parts, std::vector<int64_t> ints,
                               std::vector<double> floats, int64_t rounds, int64_t steps) {
    STD_TORCH_CHECK(rounds >= 0 && steps > 0, "solver_run: rounds and steps must be positive");
    call_ranks(buffers, parts, ints, floats, [&](auto views, const Buffers& like) {
      Backend::run_ranks(std::move(views), like, law_set(ints), rounds, steps);
    });
  }

  static void register_all(Library& m) {
    GSF_IMPL(SolverOps, solver_prime);
    GSF_IMPL(SolverOps, solver_run);
    if constexpr (Backend::kHasRanks) {
      GSF_IMPL(SolverOps, solver_ranks);
    } else {
      GSF_IMPL(SolverOps, solver_prime_ranks);
      GSF_IMPL(SolverOps, solver_run_ranks);
    }
  }

 private:
  static int law_set(const std::vector<int64_t>& ints) { return static_cast<int>(ints[kLawSet]); }

  template <typename F>
  static void call(const Buffers& b, const std::vector<int64_t>& ints,
                   const std::vector<double>& floats, F&& f) {
    STD_TORCH_CHECK(b.size() == kSolverBuffers, "solver: expected ", int(kSolverBuffers),
                    " buffers, got ", b.size());
    STD_TORCH_CHECK(ints.size() == kSolverInts && floats.size() == kSolverFloats,
                    "solver: wrong number of settings");
    STD_TORCH_CHECK(floats[kDx] > 0, "solver: dx must be positive");
    const typename Backend::Scope scope(b[kOffset]);
    dispatch_floating("solver", b[kOffset],
                      [&]<typename T>() { f(view<T>(b, ints, floats), scope); });
  }

  // f(views, one tensor of each) of the parts, and of all at the end.
  template <typename F>
  static void call_ranks(const Buffers& b, const Buffers& parts, const std::vector<int64_t>& ints,
                         const std::vector<double>& floats, F&& f) {
    STD_TORCH_CHECK(
        ints.size() == kSolverInts && int64_t(parts.size()) == ints[kRanks] * kSolverBuffers,
        "solver: expected ", int(kSolverBuffers), " buffers of each rank, got ", parts.size());
    call(b, ints, floats, [&]<typename T>(const SolverView<T>& all, const auto&) {
      std::vector<SolverView<T>> views;
      Buffers like;
      for (auto first = parts.begin(); first != parts.end(); first += kSolverBuffers) {
        const Buffers part(first, first + kSolverBuffers);
        views.push_back(view<T>(part, ints, floats));
        like.push_back(part[kOffset]);
        const SolverView<T>& s = views.back();
        STD_TORCH_CHECK(s.slot_capacity == all.slot_capacity && s.table_size == all.table_size &&
                            s.row_count == all.row_count &&
                            s.collider_count == all.collider_count &&
                            (s.moments == nullptr) == (all.moments == nullptr),
                        "solver: a rank must have the room for blocks that all have");
        STD_TORCH_CHECK(s.count > 0 && s.spare != nullptr && s.entry != nullptr &&
                            s.place != nullptr && s.count <= int64_t(1) << place_bits(s.ranks),
                        "solver: a rank must have room for 1 to 2^", place_bits(s.ranks),
                        " points, got ", s.count);
      }
      views.push_back(all);
      like.push_back(b[kOffset]);
      for (const SolverView<T>& s : views)
        STD_TORCH_CHECK(s.peers != nullptr && s.holders != nullptr && s.needers != nullptr &&
                            s.mail != nullptr && s.home_rank != nullptr && s.home_place != nullptr,
                        "solver: ranks need peers, holders, needers, mail, home_rank, home_place");
      f(std::move(views), like);
    });
  }
};

}  // namespace gsf
