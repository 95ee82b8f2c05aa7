// Colours from spherical harmonics, sixteen surfels at a time, in the sign convention of 3-D Gaussian splatting:
// colour = max(0, 0.5 + sum_k Y_k(direction) h_k), direction from the camera's centre to the surfel's.
#pragma once

#include "simd.hpp"
#include "types.hpp"

namespace mass::MASS_ISA {

inline constexpr float kY0 = 0.28209479f, kY1 = 0.48860251f;
inline constexpr float kY20 = 1.09254843f, kY21 = 0.31539157f, kY22 = 0.54627422f;
inline constexpr float kY30 = 0.59004359f, kY31 = 2.89061144f, kY32 = 0.45704580f;
inline constexpr float kY33 = 0.37317633f, kY34 = 1.44530572f;

MASS_INLINE F scaled(float k, F x) { return mul(splat(k), x); }

// Y_0 .. Y_{count-1}
MASS_INLINE void harmonic_basis(const F* d, int count, F* Y) {
    const F x = d[0], y = d[1], z = d[2];
    Y[0] = splat(kY0);
    if (count <= 1) return;
    Y[1] = scaled(-kY1, y);
    Y[2] = scaled(kY1, z);
    Y[3] = scaled(-kY1, x);
    if (count <= 4) return;
    const F xx = mul(x, x), yy = mul(y, y), zz = mul(z, z), xy = mul(x, y), two = splat(2.0f), three = splat(3.0f);
    Y[4] = scaled(kY20, xy);
    Y[5] = scaled(-kY20, mul(y, z));
    Y[6] = scaled(kY21, sub(mul(two, zz), add(xx, yy)));
    Y[7] = scaled(-kY20, mul(x, z));
    Y[8] = scaled(kY22, sub(xx, yy));
    if (count <= 9) return;
    const F rim = sub(mul(splat(4.0f), zz), add(xx, yy));
    Y[9] = scaled(-kY30, mul(y, sub(mul(three, xx), yy)));
    Y[10] = scaled(kY31, mul(xy, z));
    Y[11] = scaled(-kY32, mul(y, rim));
    Y[12] = scaled(kY33, mul(z, sub(mul(two, zz), mul(three, add(xx, yy)))));
    Y[13] = scaled(-kY32, mul(x, rim));
    Y[14] = scaled(kY34, mul(z, sub(xx, yy)));
    Y[15] = scaled(-kY30, mul(x, sub(xx, mul(three, yy))));
}

// Gradient of sum_k s_k Y_k(d) by d, for s_1 .. s_{count-1}.
MASS_INLINE void harmonic_gradient(const F* d, int count, const F* s, F* out) {
    const F x = d[0], y = d[1], z = d[2];
    out[0] = scaled(-kY1, s[3]);
    out[1] = scaled(-kY1, s[1]);
    out[2] = scaled(kY1, s[2]);
    if (count <= 4) return;
    const F s4 = scaled(kY20, s[4]), s5 = scaled(-kY20, s[5]), s6 = scaled(2.0f * kY21, s[6]);
    const F s7 = scaled(-kY20, s[7]), s8 = scaled(2.0f * kY22, s[8]);
    out[0] = add(out[0], fma(s4, y, fma(s7, z, mul(x, sub(s8, s6)))));
    out[1] = add(out[1], fma(s4, x, fma(s5, z, neg(mul(y, add(s8, s6))))));
    out[2] = add(out[2], fma(s5, y, fma(s7, x, mul(scaled(2.0f, s6), z))));
    if (count <= 9) return;
    const F xx = mul(x, x), yy = mul(y, y), zz = mul(z, z), xy = mul(x, y), xz = mul(x, z), yz = mul(y, z);
    const F s9 = scaled(-3.0f * kY30, s[9]), s10 = scaled(kY31, s[10]), s11 = scaled(-kY32, s[11]);
    const F s12 = scaled(3.0f * kY33, s[12]), s13 = scaled(-kY32, s[13]), s14 = scaled(kY34, s[14]);
    const F s15 = scaled(-3.0f * kY30, s[15]);
    const F four = splat(4.0f), three = splat(3.0f), sum = add(xx, yy), difference = sub(xx, yy);
    F gx = mul(s9, add(xy, xy));
    gx = fma(s10, yz, fnma(s11, add(xy, xy), gx));
    gx = fnma(s12, add(xz, xz), gx);
    gx = fma(s13, sub(mul(four, zz), fma(three, xx, yy)), gx);
    gx = fma(s14, add(xz, xz), fma(s15, difference, gx));
    F gy = mul(s9, difference);
    gy = fma(s10, xz, fma(s11, sub(mul(four, zz), fma(three, yy, xx)), gy));
    gy = fnma(s12, add(yz, yz), gy);
    gy = fnma(s13, add(xy, xy), gy);
    gy = fnma(s14, add(yz, yz), fnma(s15, add(xy, xy), gy));
    F gz = mul(s10, xy);
    gz = fma(s11, scaled(8.0f, yz), fma(s13, scaled(8.0f, xz), gz));
    gz = fma(s12, sub(add(zz, zz), sum), fma(s14, difference, gz));
    out[0] = add(out[0], gx);
    out[1] = add(out[1], gy);
    out[2] = add(out[2], gz);
}

// Unit direction from the camera's centre to `mean`; returns the inverse distance.
MASS_INLINE F view_direction(const CameraData& camera, const F* mean, F* d) {
    for (int k = 0; k < 3; ++k) d[k] = sub(mean[k], splat(camera.center[k]));
    const F length2 = fma(d[0], d[0], fma(d[1], d[1], mul(d[2], d[2])));
    const F inverse = div(splat(1.0f), sqrt(max(length2, splat(1e-30f))));
    for (int k = 0; k < 3; ++k) d[k] = mul(d[k], inverse);
    return inverse;
}

// 0.5 + sum_k Y_k h_k, before the clamp; `h` [3 K] holds coefficient k of channel c at 3 k + c.
MASS_INLINE void harmonic_color(const F* Y, const F* h, int count, F* color) {
    for (int c = 0; c < 3; ++c) {
        color[c] = splat(0.5f);
        for (int k = 0; k < count; ++k) color[c] = fma(Y[k], h[3 * k + c], color[c]);
    }
}

}  // namespace mass::MASS_ISA
