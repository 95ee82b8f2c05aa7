// Back to front over one tile: the backward pass.
#pragma once

#include "differentiate_pixels.hpp"
#include "reduce.hpp"
#include "tile_blocks.hpp"

namespace mass::MASS_ISA {

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
    if (gradient.depth) {
        alignas(64) float alpha[kBlocksPerTile][kLanes], depth[kBlocksPerTile][kLanes];
        read_tile(camera, w, image.alpha, 1, 0, 0.0f, &alpha[0][0]);
        read_tile(camera, w, image.depth, 1, 0, 0.0f, &depth[0][0]);
        for (int block = 0; block < kBlocksPerTile; ++block) {
            share_depth_gradient(load(alpha[block]), load(depth[block]), block, t);
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

template <bool kExtra, bool kLowPassOnly>
MASS_INLINE void differentiate_blocks(const CameraData& camera, const Splat& s, const Normal* normal, const TilePixels& pixels,
                                      float rank, unsigned todo, TileBackward& t, const TileBackwardExtra& e, PairGradient& out) {
    const SplatLimits limits = limits_of(camera, s);
    F sums[16];
    for (F& x : sums) x = splat(0.0f);
    do {
        const int block = __builtin_ctz(todo);
        todo &= todo - 1;
        const F x = load(pixels.x[block % 4]), y = load(pixels.y[block / 4]);
        differentiate_pixels<kExtra, kLowPassOnly>(camera, s, normal, limits, x, y, splat(rank), block, t, e, sums);
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
