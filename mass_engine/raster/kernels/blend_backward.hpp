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

// Returns the rank after the last pair any pixel used; a block's bit in `live_from` terms is its own largest stop.
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

template <bool kExtra>
static void blend_backward_tile(const CameraData& camera, const ProjectedData& in, const PairData& pairs, const ImageData& image,
                                const PixelState& state, const ImageGradient& gradient, const PairSums& out, int tile) {
    const TileWindow window = tile_window(camera, tile);
    const uint32_t begin = pairs.tile_begin[tile], length = pairs.tile_begin[tile + 1] - begin;
    TileBackward t;
    TileBackwardExtra e;
    int block_stop[kBlocksPerTile];
    int last = read_core(camera, window, image, state, gradient, t, block_stop);
    if (last > static_cast<int>(length)) last = static_cast<int>(length);
    if constexpr (kExtra) read_extra(camera, window, image, state, gradient, e);
    TilePixels pixels;
    tile_pixels(window.x / kTile, window.y / kTile, pixels);
    const F zero = splat(0.0f), one = splat(1.0f);

    unsigned live = 0;
    for (int rank = last - 1; rank >= 0; --rank) {
        for (int block = 0; block < kBlocksPerTile; ++block) live |= static_cast<unsigned>(block_stop[block] > rank) << block;
        const uint32_t k = begin + static_cast<uint32_t>(rank);
        __builtin_prefetch(&in.splats[pairs.surfel[rank >= 8 ? k - 8 : k]]);
        unsigned todo = pairs.blocks[k] & live;
        if (todo == 0) continue;
        const uint32_t id = pairs.surfel[k];
        const Splat& s = in.splats[id];
        const F rank_lanes = splat(static_cast<float>(rank));
        F acc[16];
        for (F& x : acc) x = zero;
        F normal[3] = {zero, zero, zero};
        bool used = false;
        do {
            const int block = __builtin_ctz(todo);
            todo &= todo - 1;
            const Sample p = sample(s, load(pixels.x[block % 4]), load(pixels.y[block / 4]));
            const M blended = both(p.valid, lt(rank_lanes, load(t.stop[block])));
            if (!any(blended)) continue;
            used = true;
            const F inverse = rcp(sub(one, p.alpha));
            const F after = load(t.transmittance[block]);
            const F before = mul(after, inverse);
            const F w = keep(blended, mul(before, p.alpha));
            store(t.transmittance[block], select(blended, before, after));

            const F gr = load(t.r[block]), gg = load(t.g[block]), gb = load(t.b[block]), gd = load(t.depth[block]);
            const F flat_or_pz = select(p.solid, p.inverse_pz, one);
            const F depth = mul(splat(s.zc), flat_or_pz);
            F loss = fma(gr, splat(s.r), fma(gg, splat(s.g), fma(gb, splat(s.b), fma(gd, depth, load(t.constant[block])))));
            F d_depth = mul(w, gd);
            F d_q = zero;
            if constexpr (kExtra) {
                const Normal& n = in.normals[id];
                const F gx = load(e.nx[block]), gy = load(e.ny[block]), gz = load(e.nz[block]);
                loss = fma(gx, splat(n.x), fma(gy, splat(n.y), fma(gz, splat(n.z), loss)));
                normal[0] = fma(w, gx, normal[0]);
                normal[1] = fma(w, gy, normal[1]);
                normal[2] = fma(w, gz, normal[2]);
                d_depth = add(d_depth, keep(both(blended, eq(rank_lanes, load(e.median_rank[block]))), load(e.median[block])));
                const F scale = splat(camera.distortion_scale), total = load(e.weight[block]), m1 = load(e.m1[block]);
                const F q = mul(select(p.solid, p.pz, one), splat(1.0f / s.zc));
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
            const M solid = both(blended, p.solid);
            const F d_rho3 = keep(solid, d_rho), d_rho2 = sub(d_rho, d_rho3);
            const F twice = keep(solid, mul(add(d_rho3, d_rho3), mul(p.inverse_pz, p.inverse_pz)));
            const F d_pu = keep(solid, mul(twice, p.pu)), d_pv = keep(solid, mul(twice, p.pv));
            F d_pz = fma(add(d_rho3, d_rho3), p.rho, mul(d_depth, depth));
            if constexpr (kExtra) d_pz = fnma(mul(d_q, splat(1.0f / s.zc)), p.pz, d_pz);
            // pz enters through its inverse; in q = pz / zc it enters directly, hence pz / zc = q times inverse.
            d_pz = neg(keep(solid, mul(d_pz, p.inverse_pz)));
            F d_zc = mul(d_depth, flat_or_pz);
            if constexpr (kExtra) {
                const F q = mul(select(p.solid, p.pz, one), splat(1.0f / s.zc));
                d_zc = fnma(mul(d_q, q), splat(1.0f / s.zc), d_zc);
            }

            acc[0] = fma(w, gr, acc[0]);
            acc[1] = fma(w, gg, acc[1]);
            acc[2] = fma(w, gb, acc[2]);
            acc[3] = fma(d_free, p.gaussian, acc[3]);
            acc[4] = fma(d_pu, p.dx, acc[4]);
            acc[5] = fma(d_pu, p.dy, acc[5]);
            acc[6] = fma(d_pv, p.dx, acc[6]);
            acc[7] = fma(d_pv, p.dy, acc[7]);
            acc[8] = fma(d_pz, p.dx, acc[8]);
            acc[9] = fma(d_pz, p.dy, acc[9]);
            acc[10] = add(d_zc, acc[10]);
            acc[11] = fma(d_rho2, p.dx, acc[11]);
            acc[12] = fma(d_rho2, p.dy, acc[12]);
            acc[13] = add(d_pu, acc[13]);
            acc[14] = add(d_pv, acc[14]);
            acc[15] = add(d_pz, acc[15]);
        } while (todo != 0);
        if (!used) continue;
        const uint32_t slot = pairs.slot[k];
        out.touched[slot] = 1;
        sum16(acc, &out.gradient[slot].r);
        if constexpr (kExtra) out.normal[slot] = {sum(normal[0]), sum(normal[1]), sum(normal[2]), 0.0f};
    }
}

void blend_backward(const CameraData& camera, const ProjectedData& in, const PairData& pairs, const ImageData& image,
                    const PixelState& state, const ImageGradient& gradient, const PairSums& out, int tile) {
    if (pairs.tile_begin[tile] == pairs.tile_begin[tile + 1]) return;
    if (out.normal) {
        blend_backward_tile<true>(camera, in, pairs, image, state, gradient, out, tile);
    } else {
        blend_backward_tile<false>(camera, in, pairs, image, state, gradient, out, tile);
    }
}

}  // namespace mass::MASS_ISA
