// Structural similarity of one pixel from its window's means, and its slopes. losses.dssim says it in plain torch.
#pragma once

#include "simd.hpp"

namespace mass::MASS_ISA {

inline constexpr int kSsimReach = 3;  // a 7 x 7 box
inline constexpr float kSsimC1 = 0.01f * 0.01f, kSsimC2 = 0.03f * 0.03f;

// Means of x, y, x^2, y^2 and x y.
struct Means {
    F x, y, xx, yy, xy;
};

// (1 - SSIM) / 2, and its slopes in the means of x, x^2 and x y.
struct Dissimilarity {
    F value, d_x, d_xx, d_xy;
};

MASS_INLINE Dissimilarity dissimilarity(const Means& m) {
    const F zero = splat(0.0f), one = splat(1.0f), two = splat(2.0f);
    const F vx = sub(m.xx, mul(m.x, m.x)), vy = sub(m.yy, mul(m.y, m.y));
    const F a = fma(two, mul(m.x, m.y), splat(kSsimC1)), b = fma(two, sub(m.xy, mul(m.x, m.y)), splat(kSsimC2));
    const F c = add(fma(m.x, m.x, mul(m.y, m.y)), splat(kSsimC1)), d = add(add(max(vx, zero), max(vy, zero)), splat(kSsimC2));
    const F inverse = div(one, mul(c, d)), s = mul(mul(a, b), inverse);
    const M positive = le(zero, vx);  // where the clamp lets its gradient through
    const F by_d = div(s, d), half = splat(-0.5f);
    const F via_means = mul(mul(two, m.y), mul(sub(b, a), inverse)), via_c = mul(mul(two, m.x), div(s, c));
    Dissimilarity r;
    r.value = mul(splat(0.5f), sub(one, s));
    r.d_x = mul(half, add(sub(via_means, via_c), keep(positive, mul(mul(two, m.x), by_d))));
    r.d_xx = mul(half, neg(keep(positive, by_d)));
    r.d_xy = mul(half, mul(mul(two, a), inverse));
    return r;
}

}  // namespace mass::MASS_ISA
