// CPU kernel of the shading op.
#include "host/shade.h"

#include "core/shade/shade.h"

namespace gsf {
namespace {

struct ShadeCpu {
  using Scope = CpuScope;
  template <typename T>
  static void shade(const ShadeArgs<T>& a, const Scope&) {
    // Short pieces: lit and shadowed rows cost many times what the backdrop does.
    parallel_for(a.height, 8, [&](int64_t begin, int64_t end) {
      for (int64_t line = begin; line < end; ++line)
        for (int64_t column = 0; column < a.width; ++column) shade_pixel(a, column, line);
    });
  }
};

}  // namespace
}  // namespace gsf

GSF_REGISTER(CPU, gsf::ShadeOps<gsf::ShadeCpu>)
