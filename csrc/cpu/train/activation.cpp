// CPU kernels of activations and rules of shape.
#include "host/activation.h"

namespace gsf {
namespace {

template <typename F>
void each(int64_t count, int64_t grain, const F& f) {
  parallel_for(count, grain, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) f(i);
  });
}

struct ActivationCpu {
  using Scope = CpuScope;
  template <typename T>
  static void activate(const ActivationArgs<T>& a, const Scope&) {
    each(a.items(), 16384, [&](int64_t i) { gsf::activate(a, i); });
  }
  template <typename T>
  static void activate_backward(const ActivationGradArgs<T>& a, const Scope&) {
    // marked by one thread: several may find something
    ActivationGradArgs<T> quiet = a;
    quiet.mark = nullptr;
    each(a.items(), 16384, [&](int64_t i) { gsf::activate_backward(quiet, i); });
    if (a.mark == nullptr) return;
    T odd = T(0);
    for (int64_t i = 0; i < 3 * a.count; ++i) odd += a.scales[i] - a.scales[i];
    for (int64_t i = 0; i < a.count; ++i) odd += a.opacities[i] - a.opacities[i];
    if (!finite(odd)) *a.mark = odd;
  }
  template <typename T>
  static void clamp_aspect(const AspectArgs<T>& a, const Scope&) {
    each(a.count, 4096, [&](int64_t i) { gsf::clamp_aspect(a, i); });
  }
  template <typename T>
  static void shorten_axes(const ShortenArgs<T>& a, const Scope&) {
    each(3 * a.count, 512, [&](int64_t i) { gsf::shorten_axes(a, i); });
  }
};

}  // namespace
}  // namespace gsf

GSF_REGISTER(CPU, gsf::ActivationOps<gsf::ActivationCpu>)
