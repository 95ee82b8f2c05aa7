// Vectors of three, sixteen at a time, and rows of numbers in and out of lanes.
#pragma once

#include "simd.hpp"

namespace mass::MASS_ISA {

struct V3 {
    F x, y, z;
};

MASS_INLINE V3 add(const V3& a, const V3& b) { return {add(a.x, b.x), add(a.y, b.y), add(a.z, b.z)}; }
MASS_INLINE V3 sub(const V3& a, const V3& b) { return {sub(a.x, b.x), sub(a.y, b.y), sub(a.z, b.z)}; }
MASS_INLINE V3 mul(F k, const V3& a) { return {mul(k, a.x), mul(k, a.y), mul(k, a.z)}; }
MASS_INLINE V3 fma(F k, const V3& a, const V3& b) { return {fma(k, a.x, b.x), fma(k, a.y, b.y), fma(k, a.z, b.z)}; }
MASS_INLINE F dot(const V3& a, const V3& b) { return fma(a.x, b.x, fma(a.y, b.y, mul(a.z, b.z))); }
MASS_INLINE V3 cross(const V3& a, const V3& b) {
    return {fnma(a.z, b.y, mul(a.y, b.z)), fnma(a.x, b.z, mul(a.z, b.x)), fnma(a.y, b.x, mul(a.x, b.y))};
}
MASS_INLINE F safe_length(const V3& a) { return sqrt(add(dot(a, a), splat(1e-24f))); }

MASS_INLINE F exp_neg(F x) { return exp2_neg(mul(x, splat(1.44269504f))); }  // e^x for x <= 0

MASS_INLINE F exp_any(F x) {
    const F e = exp_neg(neg(abs(x)));
    return select(lt(x, splat(0.0f)), e, div(splat(1.0f), e));
}

#if MASS_WIDTH == 0

// One lane is one row.
template <int width>
MASS_INLINE void load_rows(const float* in, int, F* values) {
    for (int k = 0; k < width; ++k) values[k] = in[k];
}

template <int width>
MASS_INLINE void interleave(const F* values, int, float* out) {
    for (int k = 0; k < width; ++k) out[k] = values[k];
}

#else

// Lanes of `values[width]` = in[row, width] of the first `count` rows; lanes beyond are zero.
template <int width>
MASS_INLINE void load_rows(const float* in, int count, F* values) {
    if (count == kLanes) {
        for (int k = 0; k < width; ++k) values[k] = gather(in + k, width);
        return;
    }
    alignas(64) float rows[kLanes * width] = {};
    std::memcpy(rows, in, sizeof(float) * static_cast<std::size_t>(count * width));
    for (int k = 0; k < width; ++k) values[k] = gather(rows + k, width);
}

// `out[row, width]` = lanes of `values[width]`, the first `count` of them.
template <int width>
MASS_INLINE void interleave(const F* values, int count, float* out) {
    alignas(64) float lanes[width][kLanes];
    for (int k = 0; k < width; ++k) store(lanes[k], values[k]);
    if (count == kLanes) {
        for (int l = 0; l < kLanes; ++l) {
            for (int k = 0; k < width; ++k) out[l * width + k] = lanes[k][l];
        }
    } else {
        for (int l = 0; l < count; ++l) {
            for (int k = 0; k < width; ++k) out[l * width + k] = lanes[k][l];
        }
    }
}

#endif

}  // namespace mass::MASS_ISA
