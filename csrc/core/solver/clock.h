// Time control of the resident solver: how long a step may be, when to stop. Runs on the device,
// by one thread at the end of each step, so that a frame needs no look from the host.
#pragma once

#include <cstring>

#include "core/solver/state.h"

namespace gsf {

// The largest values of a step are kept as the bits of non-negative floats: they sort like integers
// and NaN sorts above everything, so that a maximum never loses one.
GSF_HOST_DEVICE double float_of_bits(uint64_t bits) {
#ifdef __CUDA_ARCH__
  return double(__uint_as_float(uint32_t(bits)));
#else
  const uint32_t b = static_cast<uint32_t>(bits);
  float f;
  std::memcpy(&f, &b, sizeof f);
  return double(f);
#endif
}
template <typename T>
GSF_HOST_DEVICE uint64_t bits_of(T value) {
  // NaN of either sign becomes the largest pattern.
  if (!(value >= T(0))) return value < T(0) ? 0 : 0x7fffffffull;
#ifdef __CUDA_ARCH__
  return uint64_t(__float_as_uint(float(value) * 1.0000002f));
#else
  const float f = static_cast<float>(value) * 1.0000002f;  // never below the double it stands for
  uint32_t b;
  std::memcpy(&b, &f, sizeof b);
  return b;
#endif
}

// Step that the state allows: cfl dx / (c + |v|), and dt |grad v| <= limit, but never less than a
// quarter of the first rule (one wild point must not freeze the scene), and never more than
// gravity needs to move a point at rest by cfl cells (dt_most; matter may have no waves).
GSF_HOST_DEVICE double stable_step(const SolverClock& c, double dx) {
  const double speed = float_of_bits(c.speed), wave = float_of_bits(c.wave);
  const double steepest = float_of_bits(c.gradient);
  double step = c.cfl * dx / max(wave + speed, 1e-30);
  if (steepest > 0.0) {
    const double turned = c.gradient_limit / steepest;
    step = max(min(step, turned), 0.25 * step);
  }
  return min(step * c.dt_scale, c.dt_most);
}

// Length of the step that begins at `from`; 0 when nothing is left. Two even steps stand in for a
// whole one and a sliver.
GSF_HOST_DEVICE double choose_step(const SolverClock& c, double from, double dx) {
  if (c.dt_fixed > 0.0) return c.dt_fixed;
  const double left = c.until - from;
  if (!(left > 0.0)) return 0.0;
  const double step = stable_step(c, dx);
  if (step >= left) return left;
  return 2.0 * step > left ? 0.5 * left : step;
}

// Steps between two looks at wave speeds where they change slowly.
constexpr int64_t kWaveSteps = 4;

// Largest values of the step just done have been used; how far a point may move in the next one
// (twice what it would at the present speed) is kept for the particles near the end of a window.
GSF_HOST_DEVICE void reset_largest(SolverClock& c, double dx) {
  c.slack = min(0.5, 0.01 + 2.0 * float_of_bits(c.speed) * max(c.dt, c.dt_next) / dx);
  c.speed = 0;
  if (c.step % kWaveSteps == 0) c.wave = c.gradient = 0;  // measured anew in the coming step
}

GSF_HOST_DEVICE bool check_largest(SolverClock& c) {
  const double speed = float_of_bits(c.speed), wave = float_of_bits(c.wave);
  if (!(speed < 1e6 && wave < 1e6)) {
    c.reason = kNotFinite;
    return false;
  }
  c.speed_seen = max(c.speed_seen, speed);
  c.wave_seen = max(c.wave_seen, wave);
  return true;
}

// Power of two at least as large as x (x > 0, normal).
GSF_HOST_DEVICE double power_above(double x) {
  int exponent;
  using std::frexp;
  using std::ldexp;
  frexp(x, &exponent);
  return ldexp(1.0, exponent);
}

// Unit of the fixed-point momentum sums of the coming step: with unit_bits = 62 - ceil(log2(0.43
// N)) no sum over all particles can overflow, wherever they are (each gives a node at most 0.43 of
// its bound, 0.75^3 being the largest weight).
GSF_HOST_DEVICE void choose_unit(SolverClock& c) {
  using std::ldexp;
  const double bound = float_of_bits(c.bound);
  if (!(bound < 1e30)) c.reason = kNotFinite;
  c.momentum_unit = ldexp(power_above(max(bound, 1e-30)), -int(c.unit_bits));
  c.bound = 0;
}

// The first two steps after a load or at the start of a call: both from the present state.
GSF_HOST_DEVICE void start_clock(SolverClock& c, double dx) {
  if (!check_largest(c)) return;
  c.dt = choose_step(c, c.time, dx);
  c.dt_next = c.steps_left == 1 ? 0.0 : choose_step(c, c.time + c.dt, dx);
  if (!(c.dt > 0.0)) c.done = 1;
  reset_largest(c, dx);
}

// End of a step: time moves on by dt; dt_next, chosen one step ago, becomes current.
GSF_HOST_DEVICE void end_step(SolverClock& c, double dx, int64_t count) {
  c.step += 1;
  c.particle_steps += count;
  c.dt_min = c.dt_min > 0.0 ? min(c.dt_min, c.dt) : c.dt;
  c.dt_max = max(c.dt_max, c.dt);
  c.contact_nodes += c.touched;
  c.contact_steps += c.shared_sites > 0 ? 1 : 0;
  c.touched = 0;
  if (c.lost > 0) c.reason = kTooFast;
  if (c.leaving > 0) c.rebuild = 1;
  c.leaving = 0;
  if (c.travel > dx) c.rebuild = 1;
  if (!check_largest(c)) return;
  const double before = c.time;
  const bool last = !(c.dt_next > 0.0);
  c.time =
      last && c.dt_fixed <= 0.0 && c.until > before && c.steps_left != 1 ? c.until : before + c.dt;
  if (!(c.time > before)) c.reason = kStepTooSmall;
  if (c.steps_left > 0) c.steps_left -= 1;
  if (last || c.steps_left == 0) {
    c.done = 1;
    reset_largest(c, dx);
    return;
  }
  c.dt = c.dt_next;
  c.dt_next = c.steps_left == 1 ? 0.0 : choose_step(c, c.time + c.dt, dx);
  reset_largest(c, dx);
}

}  // namespace gsf
