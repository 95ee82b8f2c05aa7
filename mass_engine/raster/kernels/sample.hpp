// One surfel at the sixteen pixels of a block: shared by the forward and the backward pass, so that both see the
// same bits.
#pragma once

#include "simd.hpp"
#include "types.hpp"

namespace mass::MASS_ISA {

struct Sample {
    F dx, dy;
    F pu, pv, pz, inverse_pz;  // not set for a low-pass-only splat
    M solid;                   // the 3-D part decides: rho3 <= rho2, met beyond the near plane; likewise
    M inclined;                // and the depth is that of the ray's meeting with the plane
    F rho, gaussian, alpha;
    M valid;  // strong enough to be blended
};

// What does not change from block to block.
struct SplatLimits {
    F largest_pz;  // beyond it the ray meets the plane before the near plane
    M ray_depth;   // all or none: depth where the ray meets the plane, or the centre's
};

MASS_INLINE SplatLimits limits_of(const CameraData& camera, const Splat& s) {
    return {splat(s.zc * camera.inverse_near), lt(splat(camera.center_depth ? 1.0f : -1.0f), splat(0.0f))};
}

// kLowPassOnly: the projection has found that rho2 < rho3 wherever the surfel reaches.
template <bool kLowPassOnly>
MASS_INLINE Sample sample(const Splat& s, const SplatLimits& limits, F x, F y) {
    Sample o;
    o.dx = sub(x, splat(s.mx));
    o.dy = sub(y, splat(s.my));
    o.rho = mul(splat(kLowPass), fma(o.dx, o.dx, mul(o.dy, o.dy)));
    if constexpr (!kLowPassOnly) {
        const F rho2 = o.rho;
        o.pz = fma(splat(s.g1), o.dx, fma(splat(s.g2), o.dy, splat(1.0f)));
        o.pu = fma(splat(s.a1), o.dx, mul(splat(s.a2), o.dy));
        o.pv = fma(splat(s.b1), o.dx, mul(splat(s.b2), o.dy));
        const F radius2 = fma(o.pu, o.pu, mul(o.pv, o.pv));
        o.solid = both(le(radius2, mul(rho2, mul(o.pz, o.pz))), both(lt(splat(0.0f), o.pz), le(o.pz, limits.largest_pz)));
        o.inclined = both(o.solid, limits.ray_depth);
        o.inverse_pz = rcp(o.pz);
        o.rho = select(o.solid, mul(radius2, mul(o.inverse_pz, o.inverse_pz)), rho2);
    }
    o.gaussian = exp2_neg(mul(o.rho, splat(-0.72134752f)));  // exp(-rho / 2)
    o.alpha = min(mul(splat(s.opacity), o.gaussian), splat(kAlphaMax));
    o.valid = le(splat(kAlphaCut), o.alpha);
    return o;
}

template <bool kLowPassOnly>
MASS_INLINE F depth_of(const Splat& s, const Sample& p) {
    if constexpr (kLowPassOnly) return splat(s.zc);
    return mul(splat(s.zc), select(p.inclined, p.inverse_pz, splat(1.0f)));
}

template <bool kLowPassOnly>
MASS_INLINE F inverse_depth_of(const Splat& s, const Sample& p) {
    const F inverse = splat(1.0f / s.zc);
    if constexpr (kLowPassOnly) return inverse;
    return mul(inverse, select(p.inclined, p.pz, splat(1.0f)));
}

}  // namespace mass::MASS_ISA
