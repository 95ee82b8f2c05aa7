// World surfels -> splats, pixel bounds and sort keys.
#pragma once

#include "geometry.hpp"

namespace mass::MASS_ISA {

MASS_INLINE F ceil(F x) { return neg(floor(neg(x))); }

// ln x for positive x, absolute error below 2e-4: for bounds only.
MASS_INLINE F log_rough(F x) {
    float in[kLanes], e[kLanes], m[kLanes];
    store(in, x);
    for (int l = 0; l < kLanes; ++l) {
        uint32_t b;
        __builtin_memcpy(&b, &in[l], 4);
        e[l] = static_cast<float>(static_cast<int32_t>((b >> 23) & 255u) - 127);
        b = (b & 0x007fffffu) | 0x3f800000u;
        __builtin_memcpy(&m[l], &b, 4);
    }
    const F f = sub(load(m), splat(1.0f));
    F p = fma(splat(-0.08428509f), f, splat(0.32363037f));
    p = fma(p, f, splat(-0.67808149f));
    p = fma(p, f, splat(1.43854679f));
    return mul(splat(0.69314718f), fma(p, f, load(e)));
}

int project(const CameraData& camera, const SurfelData& in, const ProjectedData& out, int begin, int end) {
    int dropped = 0;
    const F zero = splat(0.0f), half = splat(0.5f), near_z = splat(camera.near_z);
    const M all = le(zero, zero);
    for (int first = begin; first < end; first += kLanes) {
        const int lanes = end - first < kLanes ? end - first : kLanes;
        int ids[kLanes];
        for (int l = 0; l < kLanes; ++l) ids[l] = first + (l < lanes ? l : 0);
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

        alignas(64) float record[kLanes][kLanes], normal[3][kLanes], bounds[4][kLanes], depth[kLanes];
        store(record[0], g.mx);
        store(record[1], g.my);
        store(record[2], select(g.edge_on, zero, g.a1));
        store(record[3], select(g.edge_on, zero, g.a2));
        store(record[4], select(g.edge_on, zero, g.b1));
        store(record[5], select(g.edge_on, zero, g.b2));
        store(record[6], select(g.edge_on, zero, g.g1));
        store(record[7], select(g.edge_on, zero, g.g2));
        store(record[8], zc);
        store(record[9], s.opacity);
        store(record[10], rho_cut);
        store(record[11], select(g.edge_on, splat(-1.0f), div(zc, near_z)));
        for (int k = 0; k < 3; ++k) store(record[12 + k], s.color[k]);
        store(record[15], zero);
        store(depth, zc);
        store(bounds[0], x0);
        store(bounds[1], x1);
        store(bounds[2], y0);
        store(bounds[3], y1);
        if (out.normals) {
            const F sign = select(lt(zero, g.facing), splat(-1.0f), splat(1.0f));
            for (int k = 0; k < 3; ++k) store(normal[k], mul(sign, g.n[k]));
        }
        for (int l = 0; l < lanes; ++l) {
            const int i = first + l;
            if (!(visible >> l & 1u)) {
                out.keys[i] = kCulled;
                continue;
            }
            __builtin_memcpy(&out.keys[i], &depth[l], 4);
            float* to = &out.splats[i].mx;
            for (int k = 0; k < kLanes; ++k) to[k] = record[k][l];
            out.boxes[i] = {static_cast<int16_t>(bounds[0][l]), static_cast<int16_t>(bounds[1][l]),
                            static_cast<int16_t>(bounds[2][l]), static_cast<int16_t>(bounds[3][l])};
            if (out.normals) out.normals[i] = {normal[0][l], normal[1][l], normal[2][l], 0.0f};
        }
    }
    return dropped;
}

}  // namespace mass::MASS_ISA
