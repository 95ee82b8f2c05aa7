// What a kernel sees of a GPU: its place in the grid, shared memory, barriers, the lanes of its warp; and what the host
// needs to start one. Under nvcc this is CUDA. Under another C++ compiler it is an emulation (emulator.hpp) that runs
// the same kernels in tests, on a machine without a GPU.
//
// The rules a kernel keeps, which the emulation enforces: barriers and warp operations are met by every thread of the
// block or warp; MASS_SHARED variables are declared in the kernel, hold no constructors, and are not read before they
// are written.
#pragma once

#include <cstddef>
#include <cstdint>
#include <string>

#include "device_error.hpp"

namespace mass {

inline constexpr int kWarp = 32;

}  // namespace mass

#if defined(__CUDACC__)

#include <cuda_runtime.h>

#define MASS_KERNEL(threads) static __global__ void __launch_bounds__(threads)
#define MASS_DEVICE static __device__ __forceinline__
#define MASS_SHARED __shared__

namespace mass {

using Stream = cudaStream_t;

inline void check(cudaError_t error) {
    if (error != cudaSuccess) throw DeviceError(cudaGetErrorString(error));
}

namespace device {

MASS_DEVICE int block_index() { return static_cast<int>(blockIdx.x); }
MASS_DEVICE int block_count() { return static_cast<int>(gridDim.x); }
MASS_DEVICE int thread_index() { return static_cast<int>(threadIdx.x); }
MASS_DEVICE void sync_block() { __syncthreads(); }
MASS_DEVICE bool sync_block_or(bool x) { return __syncthreads_or(x) != 0; }
MASS_DEVICE void sync_warp() { __syncwarp(); }
// Bit l: what lane l gave.
MASS_DEVICE unsigned warp_ballot(bool x) { return __ballot_sync(0xffffffffu, x); }
MASS_DEVICE bool warp_any(bool x) { return __any_sync(0xffffffffu, x) != 0; }
// The value of the lane whose number differs in the bits of `mask`.
MASS_DEVICE float warp_xor(float x, int mask) { return __shfl_xor_sync(0xffffffffu, x, mask); }
MASS_DEVICE double warp_xor(double x, int mask) { return __shfl_xor_sync(0xffffffffu, x, mask); }
MASS_DEVICE int warp_xor(int x, int mask) { return __shfl_xor_sync(0xffffffffu, x, mask); }
MASS_DEVICE void atomic_add(int* p, int x) { atomicAdd(p, x); }
MASS_DEVICE void atomic_or(int* p, int x) { atomicOr(p, x); }
MASS_DEVICE int lowest_bit(unsigned x) { return __ffs(static_cast<int>(x)) - 1; }
MASS_DEVICE int highest_bit(unsigned x) { return 31 - __clz(static_cast<int>(x)); }

}  // namespace device

// Starts a kernel on the stream; nothing for no blocks. Throws DeviceError.
template <typename... Parameters, typename... Arguments>
void launch(void (*kernel)(Parameters...), int blocks, int threads, Stream stream, Arguments... arguments) {
    if (blocks <= 0) return;
    kernel<<<static_cast<unsigned>(blocks), static_cast<unsigned>(threads), 0, stream>>>(arguments...);
    check(cudaGetLastError());
}

inline void fill_bytes(void* p, int value, std::size_t bytes, Stream stream) {
    if (bytes > 0) check(cudaMemsetAsync(p, value, bytes, stream));
}

// Makes a device current while it lives.
class DeviceGuard {
public:
    explicit DeviceGuard(int device) {
        check(cudaGetDevice(&before_));
        if (device != before_) check(cudaSetDevice(device));
        changed_ = device != before_;
    }
    ~DeviceGuard() {
        if (changed_) cudaSetDevice(before_);
    }
    DeviceGuard(const DeviceGuard&) = delete;
    DeviceGuard& operator=(const DeviceGuard&) = delete;

private:
    int before_ = 0;
    bool changed_ = false;
};

// Why no kernel can run here; empty when one can.
inline std::string device_problem() {
    int driver = 0, count = 0;
    if (cudaDriverGetVersion(&driver) != cudaSuccess || driver == 0) return "no NVIDIA driver is installed";
    const cudaError_t error = cudaGetDeviceCount(&count);
    if (error != cudaSuccess) return cudaGetErrorString(error);
    return count > 0 ? "" : "no CUDA-capable device is detected";
}

}  // namespace mass

#else

#include "emulator.hpp"

#endif
