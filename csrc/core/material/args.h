// Plain argument structs of the material kernels: pointers, sizes, scalars. Shared by the CPU loops
// and the CUDA launchers; every pointer is contiguous and lives on the kernel's device.
#pragma once

#include <cstdint>

namespace gsf {

template <typename T>
struct ReturnMappingArgs {
  int64_t count;
  const T* strain;          // [count, 6] b - I
  const T* alpha;           // [count]
  const T* increment;       // [count, 9] dt grad v
  int64_t rows;             // rows of law and params
  const int32_t* law;       // [rows]
  const T* params;          // [rows, 8]
  const int32_t* material;  // [count] row per particle, or null: row 0, or row i when rows == count
  T k, epsilon;
  bool implicit_alpha;
  bool apart;     // whether a row may have a law of more_laws.h
  T dt;           // [s], for viscosity: grad v = increment / dt
  T* strain_out;  // [count, 6]
  T* alpha_out;   // [count]
  T* stress_out;  // [count, 6] Kirchhoff [Pa]
  int32_t* info;  // [4] plastic, guarded, inverted, invalid particles; zeroed by the caller
};

template <typename T>
struct StoredEnergyArgs {
  int64_t count;
  const T* strain;          // [count, 6] b - I
  int64_t rows;             // rows of params
  const T* params;          // [rows, 8]
  const int32_t* material;  // [count] as above
  T* energy;                // [count] per initial volume [J/m^3]
};

}  // namespace gsf
