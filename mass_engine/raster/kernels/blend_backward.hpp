// Back to front over one tile: the backward pass.
//
// With s_i the loss per unit of surfel i's weight and B_i = sum over the surfels behind it of w_j s_j,
// dL/dalpha_i = T_i s_i - B_i / (1 - alpha_i). T_i comes from the final transmittance by division, B_i by adding up,
// so neither loses digits where they matter (behind, where both are small).
#pragma once

#include "reduce.hpp"
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

MASS_INLINE void read_extra(const CameraData& camera, const TileWindow& w, const ImageData& image, const PixelState& state,
                            const ImageGradient& gradient, TileBackwardExtra& e) {
    read_tile(camera, w, gradient.median, 1, 0, 0.0f, &e.median[0][0]);
    read_tile(camera, w, state.median_rank, 1, 0, -1.0f, &e.median_rank[0][0]);
    read_tile(camera, w, gradient.normal, 3, 0, 0.0f, &e.nx[0][0]);
    read_tile(camera, w, gradient.normal, 3, 1, 0.0f, &e.ny[0][0]);
    read_tile(camera, w, gradient.normal, 3, 2, 0.0f, &e.nz[0][0]);
    read_tile(camera, w, gradient.distortion, 1, 0, 0.0f, &e.distortion[0][0]);
    read_tile(camera, w, image.alpha, 1, 0, 0.0f, &e.weight[0][0]);
    read_tile(camera, w, state.moments, 3, 0, 0.0f, &e.q0[0][0]);
    read_tile(camera, w, state.moments, 3, 1, 0.0f, &e.m1[0][0]);
    read_tile(camera, w, state.moments, 3, 2, 0.0f, &e.m2[0][0]);
}

// Returns the largest stop of all pixels; block_stop is each block's.
MASS_INLINE int read_core(const CameraData& camera, const TileWindow& w, const ImageData& image, const PixelState& state,
                          const ImageGradient& gradient, TileBackward& t, int* block_stop) {
    read_tile(camera, w, state.transmittance, 1, 0, 1.0f, &t.transmittance[0][0]);
    read_tile(camera, w, state.stop, 1, 0, -1.0f, &t.stop[0][0]);
    read_tile(camera, w, gradient.rgb, 3, 0, 0.0f, &t.r[0][0]);
    read_tile(camera, w, gradient.rgb, 3, 1, 0.0f, &t.g[0][0]);
    read_tile(camera, w, gradient.rgb, 3, 2, 0.0f, &t.b[0][0]);
    read_tile(camera, w, gradient.alpha, 1, 0, 0.0f, &t.constant[0][0]);
    read_tile(camera, w, gradient.depth, 1, 0, 0.0f, &t.depth[0][0]);
    if (gradient.depth) {  // depth = sum(w z) / alpha
        alignas(64) float alpha[kBlocksPerTile][kLanes], depth[kBlocksPerTile][kLanes];
        read_tile(camera, w, image.alpha, 1, 0, 0.0f, &alpha[0][0]);
        read_tile(camera, w, image.depth, 1, 0, 0.0f, &depth[0][0]);
        for (int block = 0; block < kBlocksPerTile; ++block) {
            const F a = load(alpha[block]);
            const F g = keep(lt(splat(0.0f), a), div(load(t.depth[block]), a));
            store(t.depth[block], g);
            store(t.constant[block], fnma(g, load(depth[block]), load(t.constant[block])));
        }
    }
    int last = 0;
    for (int block = 0; block < kBlocksPerTile; ++block) {
        float most = 0.0f;
        for (int l = 0; l < kLanes; ++l) most = t.stop[block][l] > most ? t.stop[block][l] : most;
        block_stop[block] = static_cast<int>(most);
        last = block_stop[block] > last ? block_stop[block] : last;
        store(t.behind[block], splat(0.0f));
    }
    return last;
}

// Gradient of one surfel at one block, added to `sums` (in PairGradient's order). No branches: most blocks have
// something to add, and a mispredicted branch costs more than the work.
template <bool kExtra, bool kLowPassOnly>
MASS_INLINE void differentiate_block(const CameraData& camera, const Splat& s, const Normal* normal, const Sample& p, F rank,
                                     int block, TileBackward& t, const TileBackwardExtra& e, F* sums) {
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

template <bool kExtra, bool kLowPassOnly>
MASS_INLINE void differentiate_blocks(const CameraData& camera, const Splat& s, const Normal* normal, const TilePixels& pixels,
                                      float rank, unsigned todo, TileBackward& t, const TileBackwardExtra& e, PairGradient& out) {
    const SplatLimits limits = limits_of(camera, s);
    F sums[16];
    for (F& x : sums) x = splat(0.0f);
    do {
        const int block = __builtin_ctz(todo);
        todo &= todo - 1;
        const Sample p = sample<kLowPassOnly>(s, limits, load(pixels.x[block % 4]), load(pixels.y[block / 4]));
        differentiate_block<kExtra, kLowPassOnly>(camera, s, normal, p, splat(rank), block, t, e, sums);
    } while (todo != 0);
    sum16(sums, &out.r);
}

template <bool kExtra>
static int64_t blend_backward_tile(const CameraData& camera, const ProjectedData& in, const PairData& pairs, const ImageData& image,
                                const PixelState& state, const ImageGradient& gradient, const PairSums& out, int tile) {
    const TileWindow window = tile_window(camera, tile);
    const uint32_t begin = pairs.tile_begin[tile];
    TileBackward t;
    TileBackwardExtra e;
    int block_stop[kBlocksPerTile];
    const int last = read_core(camera, window, image, state, gradient, t, block_stop);
    if constexpr (kExtra) read_extra(camera, window, image, state, gradient, e);
    TilePixels pixels;
    tile_pixels(window.x / kTile, window.y / kTile, pixels);

    int64_t blocks = 0;
    unsigned live = 0;
    int next_change = last;  // the largest stop among blocks that are not live yet
    for (int rank = last - 1; rank >= 0; --rank) {
        if (rank < next_change) {
            next_change = 0;
            for (int block = 0; block < kBlocksPerTile; ++block) {
                if (block_stop[block] > rank) live |= 1u << block;
                else if (block_stop[block] > next_change) next_change = block_stop[block];
            }
        }
        const uint32_t k = begin + static_cast<uint32_t>(rank);
        const uint32_t ahead = pairs.surfel[rank >= 8 ? k - 8 : k];
        __builtin_prefetch(&in.splats[ahead]);
        if constexpr (kExtra) __builtin_prefetch(&in.normals[ahead]);
        const uint32_t id = pairs.surfel[k];
        const Splat& s = in.splats[id];
        const unsigned todo = (camera.without & kWithoutBlocks ? kAllBlocks : block_mask(s.box, window)) & live;
        if (todo == 0) continue;
        blocks += __builtin_popcount(todo);
        const Normal* normal = kExtra ? in.normals + id : nullptr;
        const uint32_t slot = slot_of(pairs, id, s.box, window);
        out.touched[slot] = 1;
        if (s.low_pass_only != 0.0f) {
            differentiate_blocks<kExtra, true>(camera, s, normal, pixels, static_cast<float>(rank), todo, t, e, out.gradient[slot]);
        } else {
            differentiate_blocks<kExtra, false>(camera, s, normal, pixels, static_cast<float>(rank), todo, t, e, out.gradient[slot]);
        }
    }
    return blocks;
}

int64_t blend_backward(const CameraData& camera, const ProjectedData& in, const PairData& pairs, const ImageData& image,
                       const PixelState& state, const ImageGradient& gradient, const PairSums& out, int tile) {
    if (pairs.tile_begin[tile] == pairs.tile_begin[tile + 1]) return 0;
    return out.extra ? blend_backward_tile<true>(camera, in, pairs, image, state, gradient, out, tile)
                     : blend_backward_tile<false>(camera, in, pairs, image, state, gradient, out, tile);
}

}  // namespace mass::MASS_ISA
