// The one macro of the project: marks functions that run on the host and, under nvcc, on the
// device.
#pragma once

#ifdef __CUDACC__
#define GSF_HOST_DEVICE __host__ __device__ __forceinline__
#else
#define GSF_HOST_DEVICE inline
#endif
