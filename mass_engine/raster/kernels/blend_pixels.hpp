// One surfel onto some pixels: the step of the forward pass.
#pragma once

#include "sample.hpp"

namespace mass::MASS_ISA {

struct alignas(64) TileForward {
    float transmittance[kBlocksPerTile][kLanes];  // negative once the pixel has ended
    float r[kBlocksPerTile][kLanes], g[kBlocksPerTile][kLanes], b[kBlocksPerTile][kLanes];
    float depth[kBlocksPerTile][kLanes];
    float stop[kBlocksPerTile][kLanes];
};

struct alignas(64) TileForwardExtra {
    float median[kBlocksPerTile][kLanes], median_rank[kBlocksPerTile][kLanes];
    float nx[kBlocksPerTile][kLanes], ny[kBlocksPerTile][kLanes], nz[kBlocksPerTile][kLanes];
    float q0[kBlocksPerTile][kLanes];  // inverse depth of the first surfel: moments are taken about it
    float weight[kBlocksPerTile][kLanes], m1[kBlocksPerTile][kLanes], m2[kBlocksPerTile][kLanes];
    float distortion[kBlocksPerTile][kLanes];
};

template <bool kLowPassOnly>
MASS_INLINE void accumulate_extra(const Splat& s, const Normal& normal, const Sample& p, M blended, F w, F before,
                                  F depth, F rank, float distortion_scale, TileForwardExtra& e, int block) {
    const M early = both(blended, lt(splat(kMedianTransmittance), before));
    store(e.median[block], select(early, depth, load(e.median[block])));
    store(e.median_rank[block], select(early, rank, load(e.median_rank[block])));
    store(e.nx[block], fma(w, splat(normal.x), load(e.nx[block])));
    store(e.ny[block], fma(w, splat(normal.y), load(e.ny[block])));
    store(e.nz[block], fma(w, splat(normal.z), load(e.nz[block])));
    // m = a - b / z; the constant a cancels, and so does the shift by the first surfel's b / z.
    const F q = inverse_depth_of<kLowPassOnly>(s, p);
    const F weight = load(e.weight[block]), m1 = load(e.m1[block]), m2 = load(e.m2[block]);
    const M first = both(blended, eq(weight, splat(0.0f)));
    const F q0 = select(first, q, load(e.q0[block]));
    const F m = keep(blended, mul(splat(distortion_scale), sub(q0, q)));
    const F pairwise = fma(mul(m, m), weight, fnma(add(m, m), m1, m2));
    store(e.q0[block], q0);
    store(e.distortion[block], fma(w, pairwise, load(e.distortion[block])));
    store(e.weight[block], add(weight, w));
    store(e.m1[block], fma(w, m, m1));
    store(e.m2[block], fma(mul(w, m), m, m2));
}

struct Blended {
    F weight;
    bool all_ended;  // this surfel ended the last of these pixels
};

// The surfel onto the pixels of `block`, whose centres are (x, y).
template <bool kExtra, bool kLowPassOnly>
MASS_INLINE Blended blend_pixels(const CameraData& camera, const Splat& s, const Normal* normal, const SplatLimits& limits, F x, F y,
                                 float rank, int block, TileForward& t, TileForwardExtra& e) {
    const Sample p = sample<kLowPassOnly>(s, limits, x, y);
    const F before = load(t.transmittance[block]);
    const F after = fnma(before, p.alpha, before);
    const M blended = both(p.valid, le(splat(kTransmittanceStop), after));
    const F w = keep(blended, mul(before, p.alpha));
    const F depth = depth_of<kLowPassOnly>(s, p);
    store(t.r[block], fma(w, splat(s.r), load(t.r[block])));
    store(t.g[block], fma(w, splat(s.g), load(t.g[block])));
    store(t.b[block], fma(w, splat(s.b), load(t.b[block])));
    store(t.depth[block], fma(w, depth, load(t.depth[block])));
    F kept = select(blended, after, before);
    if constexpr (kExtra) {
        accumulate_extra<kLowPassOnly>(s, *normal, p, blended, w, before, depth, splat(rank), camera.distortion_scale, e, block);
    }
    bool all_ended = false;
    const M ended = andnot(both(p.valid, lt(splat(0.0f), before)), blended);
    if (any(ended)) {
        store(t.stop[block], select(ended, splat(rank), load(t.stop[block])));
        kept = select(ended, neg(before), kept);
        all_ended = !any(lt(splat(0.0f), kept));
    }
    store(t.transmittance[block], kept);
    return {w, all_ended};
}

// Turns what was summed into transmittance and depth; returns alpha.
MASS_INLINE F finish_pixels(TileForward& t, int block) {
    const F T = abs(load(t.transmittance[block]));
    const F A = sub(splat(1.0f), T);
    store(t.transmittance[block], T);
    store(t.depth[block], select(lt(splat(0.0f), A), div(load(t.depth[block]), A), splat(0.0f)));
    return A;
}

}  // namespace mass::MASS_ISA
