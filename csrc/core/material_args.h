// Plain argument structs of the material kernels: pointers, sizes, scalars. Shared by the CPU loops
// and the CUDA launchers; every pointer is contiguous and lives on the kernel's device.
#pragma once

#include <cstdint>

namespace gsf {

template <typename T>
struct PolarArgs {
  int64_t count;
  const T* deformation;  // [count, 9]
  T lo, hi;              // stretch bounds [-]
  T* rotation;           // [count, 9]
  T* clamped;            // [count, 9]
};

}  // namespace gsf
