// Marks functions that run on the host and, under nvcc, on the device.
#pragma once

#ifdef __CUDACC__
#define GSF_HOST_DEVICE __host__ __device__ __forceinline__
// For rare, long paths: called and not inlined on the device, so that the common path of a kernel
// does not hold their registers.
#define GSF_HOST_DEVICE_COLD __host__ __device__ __noinline__
#else
#define GSF_HOST_DEVICE inline
#define GSF_HOST_DEVICE_COLD inline
#endif
