// Front to back over one tile: the forward pass.
#pragma once

#include "reduce.hpp"
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

// A block's bit is set while one of its pixels goes on.
MASS_INLINE unsigned start_tile(const TileWindow& w, TileForward& t, float length) {
    unsigned live = 0;
    __builtin_memset(&t, 0, sizeof t);
    for (int y = 0; y < kTile; ++y) {
        for (int x = 0; x < kTile; ++x) {
            const int at = lane_of(x, y);
            const bool inside = x < w.width && y < w.height;
            (&t.transmittance[0][0])[at] = inside ? 1.0f : -1.0f;
            (&t.stop[0][0])[at] = length;
            live |= static_cast<unsigned>(inside) << (at / kLanes);
        }
    }
    return live;
}

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

// One surfel over the blocks in `todo`. Returns the sum of its weights; clears the bits of blocks that end in `live`.
template <bool kExtra, bool kWeights, bool kLowPassOnly>
MASS_INLINE F blend_blocks(const CameraData& camera, const Splat& s, const Normal* normal, const TilePixels& pixels, float rank,
                           unsigned todo, unsigned& live, TileForward& t, TileForwardExtra& e) {
    const SplatLimits limits = limits_of(camera, s);
    F sum_of_weights = splat(0.0f);
    do {
        const int block = __builtin_ctz(todo);
        todo &= todo - 1;
        const Sample p = sample<kLowPassOnly>(s, limits, load(pixels.x[block % 4]), load(pixels.y[block / 4]));
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
        if constexpr (kWeights) sum_of_weights = add(sum_of_weights, w);
        const M ended = andnot(both(p.valid, lt(splat(0.0f), before)), blended);
        if (any(ended)) {
            store(t.stop[block], select(ended, splat(rank), load(t.stop[block])));
            kept = select(ended, neg(before), kept);
            if (!any(lt(splat(0.0f), kept)) && !(camera.without & kWithoutEarlyStop)) live &= ~(1u << block);
        }
        store(t.transmittance[block], kept);
    } while (todo != 0);
    return sum_of_weights;
}

template <bool kExtra, bool kWeights>
static int64_t blend_tile(const CameraData& camera, const ProjectedData& in, const PairData& pairs, const ImageData& out,
                       const PixelState& state, float* slot_weights, int tile) {
    const TileWindow window = tile_window(camera, tile);
    const uint32_t begin = pairs.tile_begin[tile], end = pairs.tile_begin[tile + 1];
    TileForward t;
    TileForwardExtra e;
    unsigned live = start_tile(window, t, static_cast<float>(end - begin));
    if constexpr (kExtra) {
        __builtin_memset(&e, 0, sizeof e);
        for (auto& block : e.median_rank) store(block, splat(-1.0f));
    }
    TilePixels pixels;
    tile_pixels(window.x / kTile, window.y / kTile, pixels);
    int64_t blocks = 0;

    for (uint32_t k = begin; k < end && live != 0; ++k) {
        const uint32_t ahead = pairs.surfel[k + 8 < end ? k + 8 : k];
        __builtin_prefetch(&in.splats[ahead]);
        if constexpr (kExtra) __builtin_prefetch(&in.normals[ahead]);
        const uint32_t id = pairs.surfel[k];
        const Splat& s = in.splats[id];
        const unsigned todo = (camera.without & kWithoutBlocks ? kAllBlocks : block_mask(s.box, window)) & live;
        if (todo == 0) continue;
        blocks += __builtin_popcount(todo);
        const Normal* normal = kExtra ? in.normals + id : nullptr;
        const float rank = static_cast<float>(k - begin);
        const F weights = s.low_pass_only != 0.0f
                              ? blend_blocks<kExtra, kWeights, true>(camera, s, normal, pixels, rank, todo, live, t, e)
                              : blend_blocks<kExtra, kWeights, false>(camera, s, normal, pixels, rank, todo, live, t, e);
        if constexpr (kWeights) slot_weights[slot_of(pairs, id, s.box, window)] = sum(weights);
    }

    alignas(64) float alpha[kBlocksPerTile][kLanes];
    for (int block = 0; block < kBlocksPerTile; ++block) {
        const F T = abs(load(t.transmittance[block]));
        const F A = sub(splat(1.0f), T);
        store(t.transmittance[block], T);
        store(alpha[block], A);
        store(t.depth[block], select(lt(splat(0.0f), A), div(load(t.depth[block]), A), splat(0.0f)));
    }
    write_tile(camera, window, &t.r[0][0], out.rgb, 3, 0);
    write_tile(camera, window, &t.g[0][0], out.rgb, 3, 1);
    write_tile(camera, window, &t.b[0][0], out.rgb, 3, 2);
    write_tile(camera, window, &alpha[0][0], out.alpha, 1, 0);
    write_tile(camera, window, &t.depth[0][0], out.depth, 1, 0);
    if constexpr (kExtra) {
        write_tile(camera, window, &e.median[0][0], out.median, 1, 0);
        write_tile(camera, window, &e.nx[0][0], out.normal, 3, 0);
        write_tile(camera, window, &e.ny[0][0], out.normal, 3, 1);
        write_tile(camera, window, &e.nz[0][0], out.normal, 3, 2);
        write_tile(camera, window, &e.distortion[0][0], out.distortion, 1, 0);
    }
    if (state.stop) {
        write_tile(camera, window, &t.transmittance[0][0], state.transmittance, 1, 0);
        write_tile(camera, window, &t.stop[0][0], state.stop, 1, 0);
        if constexpr (kExtra) {
            write_tile(camera, window, &e.median_rank[0][0], state.median_rank, 1, 0);
            write_tile(camera, window, &e.q0[0][0], state.moments, 3, 0);
            write_tile(camera, window, &e.m1[0][0], state.moments, 3, 1);
            write_tile(camera, window, &e.m2[0][0], state.moments, 3, 2);
        }
    }
    return blocks;
}

// An empty tile is zeros; most tiles around a hand are.
static void clear_tile(const CameraData& camera, const TileWindow& w, float* image, int channels) {
    if (!image) return;
    for (int y = 0; y < w.height; ++y) {
        __builtin_memset(image + (static_cast<int64_t>(w.y + y) * camera.width + w.x) * channels, 0,
                         static_cast<size_t>(w.width * channels) * sizeof(float));
    }
}

int64_t blend(const CameraData& camera, const ProjectedData& in, const PairData& pairs, const ImageData& out,
              const PixelState& state, float* slot_weights, int tile) {
    if (pairs.tile_begin[tile] == pairs.tile_begin[tile + 1] && !(camera.without & kWithoutEmptyTiles)) {
        const TileWindow w = tile_window(camera, tile);
        clear_tile(camera, w, out.rgb, 3);
        clear_tile(camera, w, out.alpha, 1);
        clear_tile(camera, w, out.depth, 1);
        clear_tile(camera, w, out.median, 1);
        clear_tile(camera, w, out.normal, 3);
        clear_tile(camera, w, out.distortion, 1);
        return 0;  // the backward pass skips empty tiles: their pixel state is never read
    }
    if (out.normal) {
        return slot_weights ? blend_tile<true, true>(camera, in, pairs, out, state, slot_weights, tile)
                            : blend_tile<true, false>(camera, in, pairs, out, state, slot_weights, tile);
    }
    return slot_weights ? blend_tile<false, true>(camera, in, pairs, out, state, slot_weights, tile)
                        : blend_tile<false, false>(camera, in, pairs, out, state, slot_weights, tile);
}

}  // namespace mass::MASS_ISA
