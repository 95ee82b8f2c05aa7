// Whether a surfel is seen, and which pixels it may touch.
#pragma once

#include "geometry.hpp"

namespace mass::MASS_ISA {

MASS_INLINE F ceil(F x) { return neg(floor(neg(x))); }

// ln x for positive x, absolute error below 2e-4: for bounds only.
MASS_INLINE F log_rough(F x) {
    F exponent, mantissa;
    split(x, exponent, mantissa);
    const F f = sub(mantissa, splat(1.0f));
    F p = fma(splat(-0.08428509f), f, splat(0.32363037f));
    p = fma(p, f, splat(-0.67808149f));
    p = fma(p, f, splat(1.43854679f));
    return mul(splat(0.69314718f), fma(p, f, exponent));
}

// Is rho3 >= rho2 wherever rho2 <= rho_cut? Then it is so wherever the surfel reaches, because {rho3 <= rho_cut} is
// convex and holds the centre. |(a.d, b.d)| >= (smallest singular value) |d|, pz <= 1 + |g| |d|.
MASS_INLINE M low_pass_only(const Geometry& g, F reach, M crossing) {
    const F sum = fma(g.a1, g.a1, fma(g.a2, g.a2, fma(g.b1, g.b1, mul(g.b2, g.b2))));
    const F det = fnma(g.a2, g.b1, mul(g.a1, g.b2));
    const F twice = add(det, det);
    const F root = sqrt(max(fnma(twice, twice, mul(sum, sum)), splat(0.0f)));
    const F smallest2 = div(mul(twice, det), add(sum, root));  // det^2 / (larger eigenvalue)
    const F pz = fma(sqrt(fma(g.g1, g.g1, mul(g.g2, g.g2))), reach, splat(1.0f));
    const M narrow = lt(mul(splat(1.001f * kLowPass), mul(pz, pz)), smallest2);
    return either(andnot(narrow, crossing), g.edge_on);
}

// The smallest rectangle around the projected ellipse rho3 <= rho (2DGS supplement), relative to the projected centre:
// its middle (ex, ey) and the squares of its half sides. Nonsense when the disk crosses the camera plane.
struct Extent {
    F ex, ey, hx2, hy2;
};

MASS_INLINE Extent extent(const CameraData& camera, const Geometry& g, F rho) {
    const F k00 = splat(camera.K2[0]), k01 = splat(camera.K2[1]);
    const F k10 = splat(camera.K2[2]), k11 = splat(camera.K2[3]);
    const F zc = g.c[2], spread = fma(g.u[2], g.u[2], mul(g.v[2], g.v[2]));
    const F f = div(rho, fnma(rho, spread, mul(zc, zc)));  // -c^2 / d
    const F tx0 = fma(k00, g.jn00, mul(k01, g.jn10)), tx1 = fma(k00, g.jn01, mul(k01, g.jn11));
    const F ty0 = fma(k10, g.jn00, mul(k11, g.jn10)), ty1 = fma(k10, g.jn01, mul(k11, g.jn11));
    Extent o;
    o.ex = neg(mul(f, fma(tx0, g.u[2], mul(tx1, g.v[2]))));
    o.ey = neg(mul(f, fma(ty0, g.u[2], mul(ty1, g.v[2]))));
    o.hx2 = fma(o.ex, o.ex, mul(f, fma(tx0, tx0, mul(tx1, tx1))));
    o.hy2 = fma(o.ey, o.ey, mul(f, fma(ty0, ty0, mul(ty1, ty1))));
    return o;
}

struct PixelBounds {
    F x0, x1, y0, y1;  // inclusive
    M crossing;        // the disk crosses the near plane, its image is unbounded
};

// Where the surfel may reach the alpha cut: the ellipse and the low-pass disk of radius `reach`.
MASS_INLINE PixelBounds exact_bounds(const CameraData& camera, const Geometry& g, F rho_cut, F reach) {
    const F zero = splat(0.0f), half = splat(0.5f), zc = g.c[2], near_z = splat(camera.near_z);
    const F spread = fma(g.u[2], g.u[2], mul(g.v[2], g.v[2])), gap = sub(zc, near_z);
    const M all = le(zero, zero);
    PixelBounds o;
    o.crossing = andnot(andnot(all, lt(mul(rho_cut, spread), mul(gap, gap))), g.edge_on);
    const Extent e = extent(camera, g, rho_cut);
    const F hx = sqrt(e.hx2), hy = sqrt(e.hy2);
    const F margin = splat(kBoundsMargin), slack = splat(1.0001f);
    const F wide_x = mul(slack, add(hx, abs(mul(e.ex, splat(1e-4f)))));
    const F wide_y = mul(slack, add(hy, abs(mul(e.ey, splat(1e-4f)))));
    // Edge-on: no ellipse. max and min return the second operand when the first is NaN.
    const F left = select(g.edge_on, zero, sub(e.ex, wide_x)), right = select(g.edge_on, zero, add(e.ex, wide_x));
    const F top = select(g.edge_on, zero, sub(e.ey, wide_y)), bottom = select(g.edge_on, zero, add(e.ey, wide_y));
    const F low = sub(g.mx, add(half, margin)), high = add(sub(g.mx, half), margin);
    const F lowy = sub(g.my, add(half, margin)), highy = add(sub(g.my, half), margin);
    const F width = splat(static_cast<float>(camera.width - 1)), height = splat(static_cast<float>(camera.height - 1));
    o.x0 = select(o.crossing, zero, max(ceil(add(low, min(left, neg(reach)))), zero));
    o.x1 = select(o.crossing, width, min(floor(add(high, max(right, reach))), width));
    o.y0 = select(o.crossing, zero, max(ceil(add(lowy, min(top, neg(reach)))), zero));
    o.y1 = select(o.crossing, height, min(floor(add(highy, max(bottom, reach))), height));
    return o;
}

// Whole tiles around a box of a fixed number of standard deviations whatever the opacity, as the public renderers
// have it: hbb1/diff-surfel-rasterization a square about the middle of the three-sigma ellipse, with a low-pass reach
// of 3 sqrt(1/2) px; gsplat 3.33 times the one-sigma box, without a low-pass reach.
MASS_INLINE PixelBounds tile_bounds(const CameraData& camera, const Geometry& g) {
    const bool inria = camera.bounds == Bounds::kInria;
    const F least = splat(1e-4f), tile = splat(static_cast<float>(kTile)), inverse_tile = splat(1.0f / kTile);
    const F zero = splat(0.0f), one = splat(1.0f);
    const Extent e = extent(camera, g, splat(inria ? kInriaReach * kInriaReach : 1.0f));
    F rx = sqrt(max(e.hx2, least)), ry = sqrt(max(e.hy2, least));
    F middle_x = add(g.mx, e.ex), middle_y = add(g.my, e.ey);
    if (inria) {  // its pixel centres are whole numbers
        rx = ceil(max(max(rx, ry), splat(kInriaReach * 0.70710678f)));
        ry = rx;
        middle_x = sub(middle_x, splat(0.5f));
        middle_y = sub(middle_y, splat(0.5f));
    } else {
        rx = ceil(mul(splat(kGsplatReach), rx));
        ry = ceil(mul(splat(kGsplatReach), ry));
    }
    const F width = splat(static_cast<float>(camera.width - 1)), height = splat(static_cast<float>(camera.height - 1));
    PixelBounds o;
    o.crossing = lt(one, zero);
    o.x0 = mul(max(floor(mul(sub(middle_x, rx), inverse_tile)), zero), tile);
    o.y0 = mul(max(floor(mul(sub(middle_y, ry), inverse_tile)), zero), tile);
    const F far_x = add(middle_x, rx), far_y = add(middle_y, ry);
    F end_x, end_y;
    if (inria) {
        const F nearly_tile = splat(static_cast<float>(kTile - 1));
        end_x = floor(mul(add(far_x, nearly_tile), inverse_tile));
        end_y = floor(mul(add(far_y, nearly_tile), inverse_tile));
    } else {
        end_x = ceil(mul(far_x, inverse_tile));
        end_y = ceil(mul(far_y, inverse_tile));
    }
    o.x1 = min(sub(mul(end_x, tile), one), width);
    o.y1 = min(sub(mul(end_y, tile), one), height);
    return o;
}

struct Placement {
    PixelBounds bounds;
    F reach;  // pixels from the centre at which the low-pass part falls to the alpha cut
    M seen;
};

MASS_INLINE Placement place_surfel(const CameraData& camera, const SurfelLanes& s, const Geometry& g) {
    const F zero = splat(0.0f);
    Placement o;
    const M in_front = lt(splat(camera.near_z), g.c[2]);
    o.seen = both(both(in_front, le(splat(kAlphaCut), s.opacity)), eq(mul(add(g.mx, g.my), zero), zero));
    if (camera.cull_backfaces) o.seen = both(o.seen, le(g.facing, zero));

    // rho at the alpha cut, a little generous.
    const F strongest = camera.without & kWithoutTightBounds ? max(s.opacity, splat(1.0f)) : s.opacity;
    const F rho_cut = max(fma(splat(2.0f), log_rough(mul(splat(255.0f), strongest)), splat(2e-3f)), splat(2e-3f));
    o.reach = sqrt(mul(rho_cut, splat(1.0f / kLowPass)));
    o.bounds = camera.bounds == Bounds::kExact ? exact_bounds(camera, g, rho_cut, o.reach) : tile_bounds(camera, g);
    const PixelBounds& b = o.bounds;
    o.seen = andnot(both(o.seen, both(le(b.x0, b.x1), le(b.y0, b.y1))), g.bad);
    return o;
}

// The unit normal, turned to the camera.
MASS_INLINE void normal_to_camera(const Geometry& g, F* out) {
    const F length = sqrt(g.normal2);
    const F scale = div(select(lt(splat(0.0f), g.facing), splat(-1.0f), splat(1.0f)), length);
    for (int k = 0; k < 3; ++k) out[k] = mul(scale, g.n[k]);
}

}  // namespace mass::MASS_ISA
