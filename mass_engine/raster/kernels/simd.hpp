// Sixteen floats at a time, in the namespace of the instruction set this file is compiled for.
//
// The includer defines MASS_ISA (a namespace name) and MASS_WIDTH (native lanes: 16, 8, 4 or 1; 0: one float instead of
// sixteen, a GPU thread). Everything here has internal meaning per instruction set: nothing may be shared between
// translation units with different flags.
#pragma once

#if MASS_WIDTH == 0
#include "one_lane.hpp"
#else

#include <cstdint>
#include <cstring>

#include "constants.hpp"

#if MASS_WIDTH == 16 || MASS_WIDTH == 8
#include <immintrin.h>
#elif defined(__aarch64__)
#include <arm_neon.h>
#endif

#define MASS_INLINE static inline __attribute__((always_inline))
#define MASS_ENTRY inline  // called by its address

namespace mass::MASS_ISA {

#if MASS_WIDTH == 16

using F = __m512;
using M = __mmask16;

MASS_INLINE F splat(float x) { return _mm512_set1_ps(x); }
MASS_INLINE F load(const float* p) { return _mm512_loadu_ps(p); }
MASS_INLINE void store(float* p, F x) { _mm512_storeu_ps(p, x); }
MASS_INLINE F add(F a, F b) { return _mm512_add_ps(a, b); }
MASS_INLINE F sub(F a, F b) { return _mm512_sub_ps(a, b); }
MASS_INLINE F mul(F a, F b) { return _mm512_mul_ps(a, b); }
MASS_INLINE F div(F a, F b) { return _mm512_div_ps(a, b); }
MASS_INLINE F min(F a, F b) { return _mm512_min_ps(a, b); }
MASS_INLINE F max(F a, F b) { return _mm512_max_ps(a, b); }
MASS_INLINE F fma(F a, F b, F c) { return _mm512_fmadd_ps(a, b, c); }
MASS_INLINE F fnma(F a, F b, F c) { return _mm512_fnmadd_ps(a, b, c); }  // c - a b
MASS_INLINE F sqrt(F a) { return _mm512_sqrt_ps(a); }
MASS_INLINE F abs(F a) { return _mm512_abs_ps(a); }
MASS_INLINE F neg(F a) { return _mm512_sub_ps(_mm512_setzero_ps(), a); }
MASS_INLINE F floor(F a) { return _mm512_roundscale_ps(a, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC); }
MASS_INLINE F rcp(F a) {  // one Newton step: within 2 ulp
    const F r = _mm512_rcp14_ps(a);
    return _mm512_fmadd_ps(r, _mm512_fnmadd_ps(a, r, _mm512_set1_ps(1.0f)), r);
}
MASS_INLINE M le(F a, F b) { return _mm512_cmp_ps_mask(a, b, _CMP_LE_OQ); }
MASS_INLINE M lt(F a, F b) { return _mm512_cmp_ps_mask(a, b, _CMP_LT_OQ); }
MASS_INLINE M eq(F a, F b) { return _mm512_cmp_ps_mask(a, b, _CMP_EQ_OQ); }
MASS_INLINE M both(M a, M b) { return a & b; }
MASS_INLINE M either(M a, M b) { return a | b; }
MASS_INLINE M andnot(M a, M b) { return static_cast<M>(a & ~b); }  // a and not b
MASS_INLINE F select(M m, F a, F b) { return _mm512_mask_blend_ps(m, b, a); }
MASS_INLINE F keep(M m, F a) { return _mm512_maskz_mov_ps(m, a); }
MASS_INLINE unsigned bits(M m) { return m; }
MASS_INLINE bool any(M m) { return m != 0; }

MASS_INLINE F gather(const float* p, int stride) {
    const __m512i lane = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    return _mm512_i32gather_ps(_mm512_mullo_epi32(lane, _mm512_set1_epi32(stride)), p, 4);
}

// x = mantissa * 2^exponent with mantissa in [1, 2), for positive normal x.
MASS_INLINE void split(F x, F& exponent, F& mantissa) {
    exponent = _mm512_getexp_ps(x);
    mantissa = _mm512_getmant_ps(x, _MM_MANT_NORM_1_2, _MM_MANT_SIGN_zero);
}

#else

#if MASS_WIDTH == 1
using Nf = float;
using Ni = int32_t;
#elif MASS_WIDTH == 4 && defined(__aarch64__)
using Nf = float32x4_t;
using Ni = int32x4_t;
#else
using Nf = float __attribute__((vector_size(4 * MASS_WIDTH)));
using Ni = int32_t __attribute__((vector_size(4 * MASS_WIDTH)));
#endif
constexpr int kParts = kLanes / MASS_WIDTH;

struct F {
    Nf v[kParts];
};
struct M {
    Ni v[kParts];
};

#if MASS_WIDTH == 1
MASS_INLINE Ni part_lt(Nf a, Nf b) { return -static_cast<int32_t>(a < b); }
MASS_INLINE Ni part_le(Nf a, Nf b) { return -static_cast<int32_t>(a <= b); }
MASS_INLINE Ni part_eq(Nf a, Nf b) { return -static_cast<int32_t>(a == b); }
MASS_INLINE Nf part_fma(Nf a, Nf b, Nf c) { return a * b + c; }
MASS_INLINE Nf part_set(float x) { return x; }
#else
MASS_INLINE Ni part_lt(Nf a, Nf b) { return (Ni)(a < b); }
MASS_INLINE Ni part_le(Nf a, Nf b) { return (Ni)(a <= b); }
MASS_INLINE Ni part_eq(Nf a, Nf b) { return (Ni)(a == b); }
#if MASS_WIDTH == 8
MASS_INLINE Nf part_set(float x) { return Nf{x, x, x, x, x, x, x, x}; }
MASS_INLINE Nf part_fma(Nf a, Nf b, Nf c) { return (Nf)_mm256_fmadd_ps((__m256)a, (__m256)b, (__m256)c); }
#else
MASS_INLINE Nf part_set(float x) { return Nf{x, x, x, x}; }
#if defined(__aarch64__)
MASS_INLINE Nf part_fma(Nf a, Nf b, Nf c) { return vfmaq_f32(c, a, b); }
#else
MASS_INLINE Nf part_fma(Nf a, Nf b, Nf c) { return a * b + c; }
#endif
#endif
#endif
MASS_INLINE Ni part_bits(Nf a) {
    Ni r;
    __builtin_memcpy(&r, &a, sizeof r);
    return r;
}
MASS_INLINE Nf part_float(Ni a) {
    Nf r;
    __builtin_memcpy(&r, &a, sizeof r);
    return r;
}
MASS_INLINE Nf part_select(Ni m, Nf a, Nf b) { return part_float((m & part_bits(a)) | (~m & part_bits(b))); }

#define MASS_PARTS for (int i = 0; i < kParts; ++i)
#define MASS_BINARY(name, expression) \
    MASS_INLINE F name(F a, F b) {    \
        F r;                          \
        MASS_PARTS r.v[i] = expression; \
        return r;                     \
    }
#define MASS_COMPARE(name, part)      \
    MASS_INLINE M name(F a, F b) {    \
        M r;                          \
        MASS_PARTS r.v[i] = part(a.v[i], b.v[i]); \
        return r;                     \
    }
MASS_BINARY(add, a.v[i] + b.v[i])
MASS_BINARY(sub, a.v[i] - b.v[i])
MASS_BINARY(mul, a.v[i] * b.v[i])
MASS_BINARY(div, a.v[i] / b.v[i])
MASS_BINARY(min, part_select(part_lt(a.v[i], b.v[i]), a.v[i], b.v[i]))
MASS_BINARY(max, part_select(part_lt(b.v[i], a.v[i]), a.v[i], b.v[i]))
MASS_COMPARE(le, part_le)
MASS_COMPARE(lt, part_lt)
MASS_COMPARE(eq, part_eq)
#undef MASS_BINARY
#undef MASS_COMPARE

MASS_INLINE F splat(float x) {
    F r;
    MASS_PARTS r.v[i] = part_set(x);
    return r;
}
MASS_INLINE F load(const float* p) {
    F r;
    // Part by part: copied as a whole it goes through memory in pieces that its parts then wait for.
    MASS_PARTS __builtin_memcpy(&r.v[i], p + i * MASS_WIDTH, sizeof r.v[i]);
    return r;
}
MASS_INLINE void store(float* p, F x) { MASS_PARTS __builtin_memcpy(p + i * MASS_WIDTH, &x.v[i], sizeof x.v[i]); }
MASS_INLINE F fma(F a, F b, F c) {
    F r;
    MASS_PARTS r.v[i] = part_fma(a.v[i], b.v[i], c.v[i]);
    return r;
}
MASS_INLINE F fnma(F a, F b, F c) {
    F r;
    MASS_PARTS r.v[i] = part_fma(-a.v[i], b.v[i], c.v[i]);
    return r;
}
MASS_INLINE F neg(F a) {
    F r;
    MASS_PARTS r.v[i] = -a.v[i];
    return r;
}
MASS_INLINE F abs(F a) {
    F r;
    MASS_PARTS r.v[i] = part_float(part_bits(a.v[i]) & 0x7fffffff);
    return r;
}
MASS_INLINE F sqrt(F a) {
    float x[kLanes];
    store(x, a);
    for (float& e : x) e = __builtin_sqrtf(e);
    return load(x);
}
MASS_INLINE F floor(F a) {
    float x[kLanes];
    store(x, a);
    for (float& e : x) e = __builtin_floorf(e);
    return load(x);
}
MASS_INLINE F rcp(F a) { return div(splat(1.0f), a); }
MASS_INLINE M both(M a, M b) {
    M r;
    MASS_PARTS r.v[i] = a.v[i] & b.v[i];
    return r;
}
MASS_INLINE M either(M a, M b) {
    M r;
    MASS_PARTS r.v[i] = a.v[i] | b.v[i];
    return r;
}
MASS_INLINE M andnot(M a, M b) {
    M r;
    MASS_PARTS r.v[i] = a.v[i] & ~b.v[i];
    return r;
}
MASS_INLINE F select(M m, F a, F b) {
    F r;
    MASS_PARTS r.v[i] = part_select(m.v[i], a.v[i], b.v[i]);
    return r;
}
MASS_INLINE F keep(M m, F a) {
    F r;
    MASS_PARTS r.v[i] = part_float(m.v[i] & part_bits(a.v[i]));
    return r;
}
MASS_INLINE unsigned bits(M m) {
    int32_t x[kLanes];
    __builtin_memcpy(x, &m, sizeof x);
    unsigned r = 0;
    for (int l = 0; l < kLanes; ++l) r |= static_cast<unsigned>(x[l] & 1) << l;
    return r;
}
MASS_INLINE bool any(M m) {
    Ni r = m.v[0];
    for (int i = 1; i < kParts; ++i) r |= m.v[i];
#if MASS_WIDTH == 1
    return r != 0;
#elif MASS_WIDTH == 8
    return !_mm256_testz_si256((__m256i)r, (__m256i)r);
#else
    int64_t x[MASS_WIDTH / 2];
    __builtin_memcpy(x, &r, sizeof x);
    return (x[0] | x[1]) != 0;
#endif
}
MASS_INLINE F gather(const float* p, int stride) {
    float x[kLanes];
    for (int l = 0; l < kLanes; ++l) x[l] = p[l * stride];
    return load(x);
}
// x = mantissa * 2^exponent with mantissa in [1, 2), for positive normal x.
MASS_INLINE void split(F x, F& exponent, F& mantissa) {
    float in[kLanes], e[kLanes], m[kLanes];
    store(in, x);
    for (int l = 0; l < kLanes; ++l) {
        uint32_t b;
        __builtin_memcpy(&b, &in[l], 4);
        e[l] = static_cast<float>(static_cast<int32_t>((b >> 23) & 255u) - 127);
        b = (b & 0x007fffffu) | 0x3f800000u;
        __builtin_memcpy(&m[l], &b, 4);
    }
    exponent = load(e);
    mantissa = load(m);
}

#endif  // MASS_WIDTH == 16

// 2^x for x <= 0, relative error below 3e-7; zero below 2^-126. Polynomial: smallest largest relative error on
// |f| <= 1/2 with the constant fixed at 1 (9e-8 before rounding).
MASS_INLINE F exp2_neg(F x) {
    const F c5 = splat(1.32647e-3f), c4 = splat(9.67151e-3f), c3 = splat(5.550734e-2f);
    const F c2 = splat(2.4022242e-1f), c1 = splat(6.9314698e-1f), c0 = splat(1.0f);
#if MASS_WIDTH == 16
    const F n = _mm512_roundscale_ps(x, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC);
    const F f = sub(x, n);
    const F p = fma(fma(fma(fma(fma(c5, f, c4), f, c3), f, c2), f, c1), f, c0);
    return _mm512_scalef_ps(p, n);
#else
    const M tiny = lt(x, splat(-126.0f));
    x = max(x, splat(-126.0f));
    const F magic = splat(12582912.0f);  // 1.5 * 2^23: the sum's low mantissa bits are round(x)
    const F shifted = add(x, magic);
    const F f = sub(x, sub(shifted, magic));
    F p = fma(fma(fma(fma(fma(c5, f, c4), f, c3), f, c2), f, c1), f, c0);
    MASS_PARTS p.v[i] = part_float(part_bits(p.v[i]) + (part_bits(shifted.v[i]) << 23));
    return select(tiny, splat(0.0f), p);
#endif
}

}  // namespace mass::MASS_ISA

#endif  // MASS_WIDTH == 0
