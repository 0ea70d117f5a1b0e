// Marks functions that run on the host and, under nvcc, on the device.
#pragma once

#ifdef __CUDACC__
#define GSF_HOST_DEVICE __host__ __device__ __forceinline__
#define GSF_INLINE GSF_HOST_DEVICE
#define GSF_UNROLL _Pragma("unroll")
// For rare, long paths: called and not inlined on the device, so that the common path of a kernel
// does not hold their registers.
#define GSF_HOST_DEVICE_COLD __host__ __device__ __noinline__
#else
#define GSF_HOST_DEVICE inline
// Inlined on the host too, whatever else the file holds: the innermost work of a loop.
#define GSF_INLINE [[gnu::always_inline]] inline
#define GSF_UNROLL _Pragma("GCC unroll 64")
#define GSF_HOST_DEVICE_COLD inline
#endif
