// Sums across lanes.
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

}  // namespace mass::MASS_ISA
