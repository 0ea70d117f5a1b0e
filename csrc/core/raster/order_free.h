// Sums of reals that no order of additions changes: every addend is split into whole numbers of two
// fixed units, a coarse and a fine one, and whole numbers add up exactly.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/host_device.h"

namespace gsf {

// ceil(log2(n)), n > 0.
GSF_HOST_DEVICE int bits_above(int64_t n) {
  int bits = 0;
  while (bits < 62 && (int64_t(1) << bits) < n) ++bits;
  return bits;
}

// The units for `count` addends of at most `bound`. With b = 62 - ceil(log2(count)), the coarse
// unit is 2^-b of the power of two above the bound, the fine one 2^-b of that: `count` words of at
// most 2^b + 1/2 stay below 2^63. An addend is rounded once, to half a fine unit, which is 2^-(2 b
// + 1) of the bound: 93 bits below it for the 8x8 pixels of a picture of 1920x1080 (b = 46). A
// float is held exactly down to 2^-69 of the bound, so the bound may be loose.
struct OrderFreeUnits {
  double per_coarse;  // 1 / coarse unit
  double ratio;       // fine units in a coarse one, 2^b

  GSF_HOST_DEVICE static OrderFreeUnits of(double bound, int64_t count) {
    using std::frexp;
    using std::ldexp;
    const int b = 62 - bits_above(count);
    int exponent = 0;
    // A bound of zero or next to it: all addends are zero, or as good as.
    frexp(bound > 1e-290 ? bound : 1e-290, &exponent);
    const int most = b - exponent < 1000 ? b - exponent : 1000;
    return {ldexp(1.0, most), ldexp(1.0, b)};
  }

  // False for what is not finite or above the bound: the caller must mark the sum.
  GSF_HOST_DEVICE bool split(double value, int64_t* coarse, int64_t* fine) const {
    const double units = value * per_coarse;  // exact: a power of two
    if (!(units <= ratio && units >= -ratio)) return false;
    const double whole = std::rint(units);
    *coarse = static_cast<int64_t>(whole);
    *fine = static_cast<int64_t>(std::rint((units - whole) * ratio));  // the difference is exact
    return true;
  }

  GSF_HOST_DEVICE double value(int64_t coarse, int64_t fine) const {
    return (double(coarse) + double(fine) / ratio) / per_coarse;
  }
};

}  // namespace gsf
