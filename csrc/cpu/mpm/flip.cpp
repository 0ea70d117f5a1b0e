// See cpu/mpm/flip.h. A file of its own, so that the loops of other scenes stay as they are
// compiled.
#include "cpu/mpm/flip.h"

#include "cpu/solver/homes.h"

namespace gsf::cpu {
namespace {

// The same particles with nothing that acts on them, and nodes apart from those of the step.
template <typename T>
SolverView<T> untouched(const SolverView<T>& s) {
  SolverView<T> free = s;
  free.slope = s.own;
  free.moments = nullptr;
  free.radius = nullptr;
  free.object = nullptr;
  return free;
}

}  // namespace

template <typename T>
struct FlipPass<T>::Passes {
  explicit Passes(const SolverView<T>& s)
      : of(s),
        view(untouched(s)),
        contact(view),
        surface(view),
        touch(view, contact),
        homes(view, contact, surface, touch) {}

  // Sums to velocities, in slots that got anything; clears them.
  void nodes() {
    parallel_for(static_cast<int64_t>(touched.size()), 64, [&](int64_t begin, int64_t end) {
      for (int64_t n = begin * kBlockNodes; n < end * kBlockNodes; ++n) {
        if (touched[n / kBlockNodes] == 0) continue;
        double* sum = sums.data() + 4 * n;
        const double inverse = sum[3] > double(mass_floor<T>()) ? 1.0 / sum[3] : 0.0;
        for (int c = 0; c < 3; ++c) velocity[4 * n + c] = T(sum[c] * inverse);
        std::fill_n(sum, 4, 0.0);
      }
      std::fill(touched.begin() + begin, touched.begin() + end, uint8_t(0));
    });
  }

  void keep(int64_t h) {
    const auto r = homes.range(h);
    if (r.begin == r.end) return;
    Lanes<T> tile[kWindowNodes];
    homes.for_each_run(h, [&](int t, int64_t node, int run) {
      for (int n = 0; n < run; ++n) tile[t + n] = load_quad(velocity.data() + 4 * (node + n));
    });
    using Pass = HomePass<T>;
    typename Pass::Chunk chunk;
    for (int64_t at = r.begin; at < r.end; at += Pass::kChunk) {
      chunk.gather(view, at, std::min(at + Pass::kChunk, r.end), tile);
      for (int64_t i = at; i < std::min(at + Pass::kChunk, r.end); i += Pass::kLanes) {
        const Packet<T> packet(view, view.entry + i, r.end - i);
        Pack<T> offset[3], v[3], own[9];
        const PacketGathered<T> back = chunk.gathered(i - at, offset);
        const Pack<T> speed(view.kept_speed), slope(view.kept_slope), across(view.kept_across);
        const Pack<T> scale(T(4) * view.inv_dx);
        const Pack<T> mass = pack_of<T>([&](int lane) {
          return view.rows[int64_t(view.row_of(packet.meta[lane])) * kRowColumns + kMassColumn];
        });
        packet.load3(view.velocity, v);
        packet.load9(view.own, own);
        for (int c = 0; c < 3; ++c) v[c] = speed * (v[c] - back.value[c]);
        Pack<T> lost[9];
        for (int c = 0; c < 9; ++c) lost[c] = own[c] - mass * (scale * back.first.m[c]);
        for (int c = 0; c < 9; ++c)  // leave_share
          own[c] = slope * lost[c] + across * lost[c % 3 * 3 + c / 3];
        packet.store3(v, view.velocity, packet.active);
        packet.store9(own, view.own, packet.active);
      }
    }
  }

  const SolverView<T>& of;
  SolverView<T> view;
  ContactPlan<T> contact;
  SurfacePlan<T> surface;
  TouchPlan<T> touch;
  HomePass<T> homes;
  std::vector<uint8_t> touched;  // [slots]
  std::vector<double> sums;      // [slots, 64, 4]
  std::vector<T> velocity;       // [slots, 64, 4]
};

template <typename T>
FlipPass<T>::FlipPass(const SolverView<T>& s) : passes_(std::make_unique<Passes>(s)) {}
template <typename T>
FlipPass<T>::~FlipPass() = default;

template <typename T>
void FlipPass<T>::plan() {
  Passes& p = *passes_;
  p.view = untouched(p.of);
  const int64_t slots = p.view.clock->slots;
  p.touched.assign(slots, 0);
  p.sums.assign(slots * kBlockNodes * 4, 0.0);
  p.velocity.assign(slots * kBlockNodes * 4, T(0));
  p.view.sums = p.sums.data();
  p.contact.make();
  p.surface.make();
  p.touch.make();
  p.homes.plan();
}

template <typename T>
Counts FlipPass<T>::to_nodes(int color) {
  return passes_->homes.to_nodes(color, passes_->touched);
}
template <typename T>
double* FlipPass<T>::sums() {
  return passes_->sums.data();
}
template <typename T>
uint8_t* FlipPass<T>::touched() {
  return passes_->touched.data();
}

template <typename T>
Counts FlipPass<T>::from_nodes(const HomePass<T>& homes, int laws) {
  Passes& p = *passes_;
  p.nodes();
  parallel_for(p.view.clock->homes, kHomeGrain, [&](int64_t begin, int64_t end) {
    for (int64_t h = begin; h < end; ++h) p.keep(h);
  });
  if (laws == kElasticOnly) return homes.template from_nodes<kElasticOnly, true>();
  if (laws == kBrittle) return homes.template from_nodes<kBrittle, true>();
  if (laws == kMoreLaws) return homes.template from_nodes<kMoreLaws, true>();
  if (with_springs(laws)) return homes.template from_nodes<kViscousAny, true>();
  return homes.template from_nodes<kAnyLaw, true>();
}

template class FlipPass<float>;
template class FlipPass<double>;

}  // namespace gsf::cpu
