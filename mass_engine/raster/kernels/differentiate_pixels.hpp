// The gradient of one surfel at some pixels: the step of the backward pass.
//
// With s_i the loss per unit of surfel i's weight and B_i = sum over the surfels behind it of w_j s_j,
// dL/dalpha_i = T_i s_i - B_i / (1 - alpha_i). T_i comes from the final transmittance by division, B_i by adding up,
// so neither loses digits where they matter (behind, where both are small).
#pragma once

#include "sample.hpp"

namespace mass::MASS_ISA {

struct alignas(64) TileBackward {
    float transmittance[kBlocksPerTile][kLanes], behind[kBlocksPerTile][kLanes], stop[kBlocksPerTile][kLanes];
    float r[kBlocksPerTile][kLanes], g[kBlocksPerTile][kLanes], b[kBlocksPerTile][kLanes];
    float constant[kBlocksPerTile][kLanes];  // loss per unit of weight, whatever the surfel
    float depth[kBlocksPerTile][kLanes];     // loss per weighted depth
};

struct alignas(64) TileBackwardExtra {
    float median[kBlocksPerTile][kLanes], median_rank[kBlocksPerTile][kLanes];
    float nx[kBlocksPerTile][kLanes], ny[kBlocksPerTile][kLanes], nz[kBlocksPerTile][kLanes];
    float distortion[kBlocksPerTile][kLanes], weight[kBlocksPerTile][kLanes];
    float q0[kBlocksPerTile][kLanes], m1[kBlocksPerTile][kLanes], m2[kBlocksPerTile][kLanes];
};

// depth = sum(w z) / alpha: its gradient, in t.depth, becomes one of sum(w z) and one of alpha.
MASS_INLINE void share_depth_gradient(F alpha, F depth, int block, TileBackward& t) {
    const F g = keep(lt(splat(0.0f), alpha), div(load(t.depth[block]), alpha));
    store(t.depth[block], g);
    store(t.constant[block], fnma(g, depth, load(t.constant[block])));
}

// Gradient of one surfel at the pixels (x, y) of one block, added to `sums` (in PairGradient's order). No branches: most blocks have
// something to add, and a mispredicted branch costs more than the work.
template <bool kExtra, bool kLowPassOnly>
MASS_INLINE void differentiate_pixels(const CameraData& camera, const Splat& s, const Normal* normal, const SplatLimits& limits, F x,
                                      F y, F rank, int block, TileBackward& t, const TileBackwardExtra& e, F* sums) {
    const Sample p = sample<kLowPassOnly>(s, limits, x, y);
    const F zero = splat(0.0f), one = splat(1.0f);
    const M blended = both(p.valid, lt(rank, load(t.stop[block])));
    const F inverse = rcp(sub(one, p.alpha));
    const F after = load(t.transmittance[block]);
    const F before = mul(after, inverse);
    const F w = keep(blended, mul(before, p.alpha));
    store(t.transmittance[block], select(blended, before, after));

    const F gr = load(t.r[block]), gg = load(t.g[block]), gb = load(t.b[block]), gd = load(t.depth[block]);
    const F depth = depth_of<kLowPassOnly>(s, p);
    F loss = fma(gr, splat(s.r), fma(gg, splat(s.g), fma(gb, splat(s.b), fma(gd, depth, load(t.constant[block])))));
    F d_depth = mul(w, gd), d_q = zero, q = zero;
    if constexpr (kExtra) {
        const F gx = load(e.nx[block]), gy = load(e.ny[block]), gz = load(e.nz[block]);
        loss = fma(gx, splat(normal->x), fma(gy, splat(normal->y), fma(gz, splat(normal->z), loss)));
        sums[13] = fma(w, gx, sums[13]);
        sums[14] = fma(w, gy, sums[14]);
        sums[15] = fma(w, gz, sums[15]);
        d_depth = add(d_depth, keep(both(blended, eq(rank, load(e.median_rank[block]))), load(e.median[block])));
        const F scale = splat(camera.distortion_scale), total = load(e.weight[block]), m1 = load(e.m1[block]);
        q = inverse_depth_of<kLowPassOnly>(s, p);
        const F m = mul(scale, sub(load(e.q0[block]), q)), gl = load(e.distortion[block]);
        loss = fma(gl, fma(mul(m, m), total, fnma(add(m, m), m1, load(e.m2[block]))), loss);
        // dL/dm_i = 2 w_i (m_i A - D1), dm/dq = -scale
        d_q = mul(mul(splat(-2.0f), mul(scale, gl)), mul(w, fma(m, total, neg(m1))));
    }
    const F behind = load(t.behind[block]);
    const F d_alpha = fnma(behind, inverse, mul(before, loss));
    store(t.behind[block], fma(w, loss, behind));

    // The clamp passes no gradient.
    const M free = both(blended, lt(mul(splat(s.opacity), p.gaussian), splat(kAlphaMax)));
    const F d_free = keep(free, d_alpha);
    const F d_rho = mul(splat(-0.5f), mul(d_free, p.alpha));
    sums[0] = fma(w, gr, sums[0]);
    sums[1] = fma(w, gg, sums[1]);
    sums[2] = fma(w, gb, sums[2]);
    sums[3] = fma(d_free, p.gaussian, sums[3]);

    // rho2 = kLowPass |d|^2, d = pixel - (mx, my)
    F d_rho2 = d_rho, d_zc = d_depth;
    if constexpr (!kLowPassOnly) {
        const M solid = both(blended, p.solid);
        const F d_rho3 = keep(solid, d_rho);
        d_rho2 = sub(d_rho, d_rho3);
        const F twice = keep(solid, mul(add(d_rho3, d_rho3), mul(p.inverse_pz, p.inverse_pz)));
        const F d_pu = keep(solid, mul(twice, p.pu)), d_pv = keep(solid, mul(twice, p.pv));
        // pz enters rho3 and the depth through its inverse, and q = pz / zc directly.
        F through_depth = mul(d_depth, depth);
        if constexpr (kExtra) through_depth = fnma(d_q, q, through_depth);
        F d_pz = fma(add(d_rho3, d_rho3), p.rho, keep(p.inclined, through_depth));
        d_pz = neg(keep(solid, mul(d_pz, p.inverse_pz)));
        sums[4] = fma(d_pu, p.dx, sums[4]);
        sums[5] = fma(d_pu, p.dy, sums[5]);
        sums[6] = fma(d_pv, p.dx, sums[6]);
        sums[7] = fma(d_pv, p.dy, sums[7]);
        sums[8] = fma(d_pz, p.dx, sums[8]);
        sums[9] = fma(d_pz, p.dy, sums[9]);
        sums[11] = fnma(d_pu, splat(s.a1), fnma(d_pv, splat(s.b1), fnma(d_pz, splat(s.g1), sums[11])));
        sums[12] = fnma(d_pu, splat(s.a2), fnma(d_pv, splat(s.b2), fnma(d_pz, splat(s.g2), sums[12])));
        d_zc = mul(d_depth, select(p.inclined, p.inverse_pz, one));
    }
    if constexpr (kExtra) d_zc = fnma(mul(d_q, q), splat(1.0f / s.zc), d_zc);
    const F push = mul(d_rho2, splat(-2.0f * kLowPass));
    sums[10] = add(sums[10], d_zc);
    sums[11] = fma(push, p.dx, sums[11]);
    sums[12] = fma(push, p.dy, sums[12]);
}

}  // namespace mass::MASS_ISA
