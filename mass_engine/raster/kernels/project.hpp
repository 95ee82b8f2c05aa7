// World surfels -> splats, pixel bounds and sort keys.
#pragma once

#include "geometry.hpp"
#include "reduce.hpp"

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

int project(const CameraData& camera, const SurfelData& in, const ProjectedData& out, int begin, int end) {
    int dropped = 0;
    const F zero = splat(0.0f), half = splat(0.5f), near_z = splat(camera.near_z);
    const M all = le(zero, zero);
    for (int first = begin; first < end; first += kLanes) {
        const int lanes = end - first < kLanes ? end - first : kLanes;
        int ids[kLanes];
        for (int l = 0; l < kLanes; ++l) ids[l] = first + (l < lanes ? l : 0);
        if (first + 9 * kLanes <= in.count) prefetch_run(in, first + 8 * kLanes);
        const SurfelLanes s = lanes == kLanes ? load_run(in, first) : load_lanes(in, ids);
        const Geometry g = make_geometry(camera, s);
        const F zc = g.c[2];

        const M in_front = lt(near_z, zc);
        M seen = both(both(in_front, le(splat(kAlphaCut), s.opacity)), eq(mul(add(g.mx, g.my), zero), zero));
        if (camera.cull_backfaces) seen = both(seen, le(g.facing, zero));

        // rho at the alpha cut, a little generous.
        const F rho_cut = max(fma(splat(2.0f), log_rough(mul(splat(255.0f), s.opacity)), splat(2e-3f)), splat(2e-3f));
        const F reach = sqrt(mul(rho_cut, splat(1.0f / kLowPass)));
        // Bounds of the projected ellipse rho3 <= rho_cut (2DGS supplement), relative to the centre. When the disk
        // crosses the near plane its image is unbounded.
        const F su = s.scale[0], sv = s.scale[1];
        const F tz0 = mul(su, g.u[2]), tz1 = mul(sv, g.v[2]);
        const F spread = fma(tz0, tz0, mul(tz1, tz1));
        const M crossing = andnot(andnot(all, lt(mul(rho_cut, spread), mul(sub(zc, near_z), sub(zc, near_z)))), g.edge_on);
        const F f = div(rho_cut, fnma(rho_cut, spread, mul(zc, zc)));  // -c^2 / d
        const F k00 = splat(camera.K2[0]), k01 = splat(camera.K2[1]), k10 = splat(camera.K2[2]), k11 = splat(camera.K2[3]);
        const F tx0 = mul(su, fma(k00, g.jn00, mul(k01, g.jn10))), tx1 = mul(sv, fma(k00, g.jn01, mul(k01, g.jn11)));
        const F ty0 = mul(su, fma(k10, g.jn00, mul(k11, g.jn10))), ty1 = mul(sv, fma(k10, g.jn01, mul(k11, g.jn11)));
        const F ex = neg(mul(f, fma(tx0, tz0, mul(tx1, tz1)))), ey = neg(mul(f, fma(ty0, tz0, mul(ty1, tz1))));
        const F hx = sqrt(fma(ex, ex, mul(f, fma(tx0, tx0, mul(tx1, tx1)))));
        const F hy = sqrt(fma(ey, ey, mul(f, fma(ty0, ty0, mul(ty1, ty1)))));
        const F margin = splat(kBoundsMargin), slack = splat(1.0001f);
        const F wide_x = mul(slack, add(hx, abs(mul(ex, splat(1e-4f))))), wide_y = mul(slack, add(hy, abs(mul(ey, splat(1e-4f)))));
        // Edge-on: no ellipse. max and min return the second operand when the first is NaN.
        const F left = select(g.edge_on, zero, sub(ex, wide_x)), right = select(g.edge_on, zero, add(ex, wide_x));
        const F top = select(g.edge_on, zero, sub(ey, wide_y)), bottom = select(g.edge_on, zero, add(ey, wide_y));
        const F low = sub(g.mx, add(half, margin)), high = add(sub(g.mx, half), margin);
        const F lowy = sub(g.my, add(half, margin)), highy = add(sub(g.my, half), margin);
        const F width = splat(static_cast<float>(camera.width - 1)), height = splat(static_cast<float>(camera.height - 1));
        F x0 = max(ceil(add(low, min(left, neg(reach)))), zero), x1 = min(floor(add(high, max(right, reach))), width);
        F y0 = max(ceil(add(lowy, min(top, neg(reach)))), zero), y1 = min(floor(add(highy, max(bottom, reach))), height);
        x0 = select(crossing, zero, x0);
        y0 = select(crossing, zero, y0);
        x1 = select(crossing, width, x1);
        y1 = select(crossing, height, y1);
        seen = andnot(both(seen, both(le(x0, x1), le(y0, y1))), g.bad);

        const unsigned exists = (1u << lanes) - 1u;
        const unsigned bad = bits(g.bad) & exists;
        dropped += __builtin_popcount(bad);
        const unsigned visible = bits(seen) & exists;

        alignas(64) float bounds[4][kLanes], depth[kLanes], normal[3][kLanes];
        alignas(64) Box box[kLanes];
        alignas(64) float box_low[kLanes], box_high[kLanes];
        store(depth, zc);
        store(bounds[0], x0);
        store(bounds[1], x1);
        store(bounds[2], y0);
        store(bounds[3], y1);
        for (int l = 0; l < kLanes; ++l) {
            const bool shown = visible >> l & 1u;
            box[l] = {static_cast<int16_t>(shown ? bounds[0][l] : 0), static_cast<int16_t>(shown ? bounds[1][l] : -1),
                      static_cast<int16_t>(shown ? bounds[2][l] : 0), static_cast<int16_t>(shown ? bounds[3][l] : -1)};
            __builtin_memcpy(&box_low[l], &box[l].x0, 4);
            __builtin_memcpy(&box_high[l], &box[l].y0, 4);
        }
        __builtin_memcpy(out.boxes + first, box, sizeof(Box) * static_cast<size_t>(lanes));
        __builtin_memcpy(out.keys + first, depth, sizeof(float) * static_cast<size_t>(lanes));
        if (visible == 0) continue;

        F rows[kLanes] = {g.mx, g.my, g.a1, g.a2, g.b1, g.b2, g.g1, g.g2, zc, s.opacity, s.color[0], s.color[1], s.color[2],
                          keep(low_pass_only(g, reach, crossing), splat(1.0f)), load(box_low), load(box_high)};
        transpose16(rows);
        for (int l = 0; l < lanes; ++l) store(&out.splats[first + l].mx, rows[l]);
        if (out.normals) {
            const F sign = select(lt(zero, g.facing), splat(-1.0f), splat(1.0f));
            for (int k = 0; k < 3; ++k) store(normal[k], mul(sign, g.n[k]));
            for (int l = 0; l < lanes; ++l) out.normals[first + l] = {normal[0][l], normal[1][l], normal[2][l], 0.0f};
        }
    }
    return dropped;
}

}  // namespace mass::MASS_ISA
