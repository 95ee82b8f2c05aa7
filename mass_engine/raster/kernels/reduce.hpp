// Sums across lanes, and transposition.
#pragma once

#include "simd.hpp"

namespace mass::MASS_ISA {

#if MASS_WIDTH == 16

MASS_INLINE float sum(F x) { return _mm512_reduce_add_ps(x); }

// out[i] = sum of the lanes of x[i]: four rounds of pairwise adds, each halving the number of vectors.
MASS_INLINE void sum16(const F* x, float* out) {
    F a[8], b[4], c[2];
    for (int i = 0; i < 8; ++i) {
        a[i] = add(_mm512_unpacklo_ps(x[2 * i], x[2 * i + 1]), _mm512_unpackhi_ps(x[2 * i], x[2 * i + 1]));
    }
    for (int i = 0; i < 4; ++i) {
        const __m512d p = _mm512_castps_pd(a[2 * i]), q = _mm512_castps_pd(a[2 * i + 1]);
        b[i] = add(_mm512_castpd_ps(_mm512_unpacklo_pd(p, q)), _mm512_castpd_ps(_mm512_unpackhi_pd(p, q)));
    }
    for (int i = 0; i < 2; ++i) {
        c[i] = add(_mm512_shuffle_f32x4(b[2 * i], b[2 * i + 1], 0x88), _mm512_shuffle_f32x4(b[2 * i], b[2 * i + 1], 0xdd));
    }
    store(out, add(_mm512_shuffle_f32x4(c[0], c[1], 0x88), _mm512_shuffle_f32x4(c[0], c[1], 0xdd)));
}

// Row r, lane c <-> row c, lane r.
MASS_INLINE void transpose16(F* x) {
    F a[16], b[16];
    for (int i = 0; i < 8; ++i) {
        a[2 * i] = _mm512_unpacklo_ps(x[2 * i], x[2 * i + 1]);
        a[2 * i + 1] = _mm512_unpackhi_ps(x[2 * i], x[2 * i + 1]);
    }
    // b[4 i + j], 128-bit lane k: column 4 k + j of rows 4 i .. 4 i + 3
    for (int i = 0; i < 4; ++i) {
        for (int h = 0; h < 2; ++h) {
            const __m512d p = _mm512_castps_pd(a[4 * i + h]), q = _mm512_castps_pd(a[4 * i + 2 + h]);
            b[4 * i + 2 * h] = _mm512_castpd_ps(_mm512_unpacklo_pd(p, q));
            b[4 * i + 2 * h + 1] = _mm512_castpd_ps(_mm512_unpackhi_pd(p, q));
        }
    }
    for (int j = 0; j < 4; ++j) {
        const F even_low = _mm512_shuffle_f32x4(b[j], b[4 + j], 0x88), odd_low = _mm512_shuffle_f32x4(b[j], b[4 + j], 0xdd);
        const F even_high = _mm512_shuffle_f32x4(b[8 + j], b[12 + j], 0x88), odd_high = _mm512_shuffle_f32x4(b[8 + j], b[12 + j], 0xdd);
        x[j] = _mm512_shuffle_f32x4(even_low, even_high, 0x88);
        x[8 + j] = _mm512_shuffle_f32x4(even_low, even_high, 0xdd);
        x[4 + j] = _mm512_shuffle_f32x4(odd_low, odd_high, 0x88);
        x[12 + j] = _mm512_shuffle_f32x4(odd_low, odd_high, 0xdd);
    }
}

#elif MASS_WIDTH == 8

MASS_INLINE float sum(F x) {
    const __m256 a = (__m256)x.v[0] + (__m256)x.v[1];
    __m128 b = _mm_add_ps(_mm256_castps256_ps128(a), _mm256_extractf128_ps(a, 1));
    b = _mm_add_ps(b, _mm_movehl_ps(b, b));
    return _mm_cvtss_f32(_mm_add_ss(b, _mm_shuffle_ps(b, b, 1)));
}

MASS_INLINE void sum16(const F* x, float* out) {
    for (int h = 0; h < 2; ++h) {
        __m256 a[8];
        for (int i = 0; i < 8; ++i) a[i] = (__m256)x[8 * h + i].v[0] + (__m256)x[8 * h + i].v[1];
        const __m256 b0 = _mm256_hadd_ps(_mm256_hadd_ps(a[0], a[1]), _mm256_hadd_ps(a[2], a[3]));
        const __m256 b1 = _mm256_hadd_ps(_mm256_hadd_ps(a[4], a[5]), _mm256_hadd_ps(a[6], a[7]));
        _mm256_storeu_ps(out + 8 * h, _mm256_permute2f128_ps(b0, b1, 0x20) + _mm256_permute2f128_ps(b0, b1, 0x31));
    }
}

#else

MASS_INLINE float sum(F x) {
    float y[kLanes];
    store(y, x);
    for (int step = kLanes / 2; step > 0; step /= 2) {
        for (int l = 0; l < step; ++l) y[l] += y[l + step];
    }
    return y[0];
}

MASS_INLINE void sum16(const F* x, float* out) {
    for (int i = 0; i < 16; ++i) out[i] = sum(x[i]);
}

#endif

#if MASS_WIDTH != 16
// Row r, lane c <-> row c, lane r.
MASS_INLINE void transpose16(F* x) {
    float a[16][kLanes], b[16][kLanes];
    __builtin_memcpy(a, x, sizeof a);
    for (int r = 0; r < 16; ++r) {
        for (int c = 0; c < 16; ++c) b[c][r] = a[r][c];
    }
    __builtin_memcpy(x, b, sizeof b);
}
#endif

}  // namespace mass::MASS_ISA
