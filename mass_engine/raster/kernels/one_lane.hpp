// The names of simd.hpp for one float: a GPU thread has one pixel or one surfel. Under another compiler than nvcc the
// same for the emulation.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

#include "constants.hpp"

#if defined(__CUDACC__)
#define MASS_INLINE static __device__ __forceinline__
#else
#define MASS_INLINE static inline __attribute__((always_inline))
#endif

#define MASS_ENTRY MASS_INLINE

namespace mass::MASS_ISA {

// A tile's arrays shrink to the thread's own pixel.
inline constexpr int kLanes = 1;
inline constexpr int kBlocksPerTile = 1;

using F = float;
using M = bool;

MASS_INLINE F splat(float x) { return x; }
MASS_INLINE F load(const float* p) { return *p; }
MASS_INLINE void store(float* p, F x) { *p = x; }
MASS_INLINE F add(F a, F b) { return a + b; }
MASS_INLINE F sub(F a, F b) { return a - b; }
MASS_INLINE F mul(F a, F b) { return a * b; }
MASS_INLINE F div(F a, F b) { return a / b; }
// The second operand when one is NaN, as everywhere else.
MASS_INLINE F min(F a, F b) { return a < b ? a : b; }
MASS_INLINE F max(F a, F b) { return b < a ? a : b; }
MASS_INLINE F neg(F a) { return -a; }
MASS_INLINE F abs(F a) { return ::fabsf(a); }
MASS_INLINE F sqrt(F a) { return ::sqrtf(a); }
MASS_INLINE F floor(F a) { return ::floorf(a); }
MASS_INLINE M le(F a, F b) { return a <= b; }
MASS_INLINE M lt(F a, F b) { return a < b; }
MASS_INLINE M eq(F a, F b) { return a == b; }
MASS_INLINE M both(M a, M b) { return a && b; }
MASS_INLINE M either(M a, M b) { return a || b; }
MASS_INLINE M andnot(M a, M b) { return a && !b; }
MASS_INLINE F select(M m, F a, F b) { return m ? a : b; }
MASS_INLINE F keep(M m, F a) { return m ? a : 0.0f; }
MASS_INLINE bool any(M m) { return m; }

#if defined(__CUDA_ARCH__)
MASS_INLINE F fma(F a, F b, F c) { return __fmaf_rn(a, b, c); }
MASS_INLINE F fnma(F a, F b, F c) { return __fmaf_rn(-a, b, c); }
MASS_INLINE F rcp(F a) {  // within 1 ulp
    float r;
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(a));
    return r;
}
// 2^x for x <= 0, relative error below 2^-22; zero below 2^-126.
MASS_INLINE F exp2_neg(F x) {
    float r;
    asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(x));
    return r;
}
#else
MASS_INLINE F fma(F a, F b, F c) { return a * b + c; }
MASS_INLINE F fnma(F a, F b, F c) { return -a * b + c; }
MASS_INLINE F rcp(F a) { return 1.0f / a; }
MASS_INLINE F exp2_neg(F x) { return x < -126.0f ? 0.0f : ::exp2f(x); }
#endif

// x = mantissa * 2^exponent with mantissa in [1, 2), for positive normal x.
MASS_INLINE void split(F x, F& exponent, F& mantissa) {
    uint32_t b;
    memcpy(&b, &x, sizeof b);
    exponent = static_cast<float>(static_cast<int32_t>((b >> 23) & 255u) - 127);
    b = (b & 0x007fffffu) | 0x3f800000u;
    memcpy(&mantissa, &b, sizeof b);
}

}  // namespace mass::MASS_ISA
