// Front to back over one tile: the forward pass.
#pragma once

#include "blend_pixels.hpp"
#include "reduce.hpp"
#include "tile_blocks.hpp"

namespace mass::MASS_ISA {

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

// One surfel over the blocks in `todo`. Returns the sum of its weights; clears the bits of blocks that end in `live`.
template <bool kExtra, bool kWeights, bool kLowPassOnly>
MASS_INLINE F blend_blocks(const CameraData& camera, const Splat& s, const Normal* normal, const TilePixels& pixels, float rank,
                           unsigned todo, unsigned& live, TileForward& t, TileForwardExtra& e) {
    const SplatLimits limits = limits_of(camera, s);
    F sum_of_weights = splat(0.0f);
    do {
        const int block = __builtin_ctz(todo);
        todo &= todo - 1;
        const F x = load(pixels.x[block % 4]), y = load(pixels.y[block / 4]);
        const Blended b = blend_pixels<kExtra, kLowPassOnly>(camera, s, normal, limits, x, y, rank, block, t, e);
        if constexpr (kWeights) sum_of_weights = add(sum_of_weights, b.weight);
        if (b.all_ended && !(camera.without & kWithoutEarlyStop)) live &= ~(1u << block);
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
        store(alpha[block], finish_pixels(t, block));
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
