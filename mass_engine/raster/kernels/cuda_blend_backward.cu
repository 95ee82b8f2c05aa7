// Back to front over the tiles: the backward pass. A pair's sums over its pixels are added in a fixed order, first within
// each warp, then over the tile's warps; one record a pair, no atomics, the same bits every time.
#define MASS_ISA device
#define MASS_WIDTH 0
#include "cuda_surfel.hpp"
#include "cuda_tile.hpp"
#include "differentiate_pixels.hpp"

namespace mass::device {

constexpr int kBackBatch = 64;
constexpr int kGroups = kBackBatch / kWarp;
constexpr int kSums = 16;

// `outside` where there is no pixel, zero where there is no image.
MASS_DEVICE float read_pixel(const PixelPlace& p, const float* image, int channels, int channel, float outside) {
    return !p.inside ? outside : image ? image[p.at * channels + channel] : 0.0f;
}

MASS_DEVICE TileBackward read_core(const PixelPlace& p, const ImageData& image, const PixelState& state, const ImageGradient& gradient) {
    TileBackward t{};
    t.transmittance[0][0] = read_pixel(p, state.transmittance, 1, 0, 1.0f);
    t.stop[0][0] = read_pixel(p, state.stop, 1, 0, -1.0f);
    t.r[0][0] = read_pixel(p, gradient.rgb, 3, 0, 0.0f);
    t.g[0][0] = read_pixel(p, gradient.rgb, 3, 1, 0.0f);
    t.b[0][0] = read_pixel(p, gradient.rgb, 3, 2, 0.0f);
    t.constant[0][0] = read_pixel(p, gradient.alpha, 1, 0, 0.0f);
    t.depth[0][0] = read_pixel(p, gradient.depth, 1, 0, 0.0f);
    if (gradient.depth) share_depth_gradient(read_pixel(p, image.alpha, 1, 0, 0.0f), read_pixel(p, image.depth, 1, 0, 0.0f), 0, t);
    return t;
}

MASS_DEVICE TileBackwardExtra read_extra(const PixelPlace& p, const ImageData& image, const PixelState& state, const ImageGradient& gradient) {
    TileBackwardExtra e{};
    e.median[0][0] = read_pixel(p, gradient.median, 1, 0, 0.0f);
    e.median_rank[0][0] = read_pixel(p, state.median_rank, 1, 0, -1.0f);
    e.nx[0][0] = read_pixel(p, gradient.normal, 3, 0, 0.0f);
    e.ny[0][0] = read_pixel(p, gradient.normal, 3, 1, 0.0f);
    e.nz[0][0] = read_pixel(p, gradient.normal, 3, 2, 0.0f);
    e.distortion[0][0] = read_pixel(p, gradient.distortion, 1, 0, 0.0f);
    e.weight[0][0] = read_pixel(p, image.alpha, 1, 0, 0.0f);
    e.q0[0][0] = read_pixel(p, state.moments, 3, 0, 0.0f);
    e.m1[0][0] = read_pixel(p, state.moments, 3, 1, 0.0f);
    e.m2[0][0] = read_pixel(p, state.moments, 3, 2, 0.0f);
    return e;
}

MASS_DEVICE int warp_most(int x) {
    for (int mask = kWarp / 2; mask > 0; mask /= 2) {
        const int other = warp_xor(x, mask);
        x = other > x ? other : x;
    }
    return x;
}

template <bool kExtra>
MASS_KERNEL(kTileThreads)
differentiate_tiles(CameraData camera, ProjectedData in, PairData pairs, ImageData image, PixelState state, ImageGradient gradient,
                    PairSums out) {
    MASS_SHARED Splat splats[kBackBatch];
    MASS_SHARED Normal normals[kExtra ? kBackBatch : 1];
    MASS_SHARED uint32_t slots[kBackBatch];
    MASS_SHARED float warp_sums[kTileWarps][kBackBatch][kSums];
    MASS_SHARED unsigned warp_touched[kTileWarps][kGroups];
    MASS_SHARED int warp_stops[kTileWarps];
    const int tile = block_index();
    const TileWindow window = tile_window(camera, tile);
    const PixelPlace p = pixel_place(camera, window);
    const float x = static_cast<float>(p.x) + 0.5f, y = static_cast<float>(p.y) + 0.5f;
    const uint32_t begin = pairs.tile_begin[tile];
    if (begin == pairs.tile_begin[tile + 1]) return;
    TileBackward t = read_core(p, image, state, gradient);
    TileBackwardExtra e{};
    if constexpr (kExtra) e = read_extra(p, image, state, gradient);

    const int warp_stop = warp_most(static_cast<int>(t.stop[0][0]));  // the warp's pixels end before this rank
    if (p.lane == 0) warp_stops[p.warp] = warp_stop;
    sync_block();
    int last = 0;
    for (int warp = 0; warp < kTileWarps; ++warp) last = warp_stops[warp] > last ? warp_stops[warp] : last;

    for (int after = last; after > 0; after -= kBackBatch) {  // ranks first .. after - 1
        const int first = after > kBackBatch ? after - kBackBatch : 0, count = after - first;
        const uint32_t* ids = pairs.surfel + begin + first;
        // None still reads the surfels of the batch before: its sums were met by all. Its sums are read until the next barrier.
        fetch(in.splats, ids, count, splats);
        if constexpr (kExtra) fetch(in.normals, ids, count, normals);
        sync_block();
        if (thread_index() < count) slots[thread_index()] = slot_of(pairs, ids[thread_index()], splats[thread_index()].box, window);
        for (int group = kGroups - 1; group >= 0; --group) {
            const int mine = group * kWarp + p.lane;
            const bool near = mine < count && first + mine < warp_stop && near_warp(splats[mine < count ? mine : 0].box, p);
            unsigned todo = warp_ballot(near);
            if (p.lane == 0) warp_touched[p.warp][group] = todo;
            while (todo != 0) {
                const int bit = highest_bit(todo), j = group * kWarp + bit;
                todo &= ~(1u << bit);
                const Splat& s = splats[j];
                const Normal* normal = kExtra ? normals + j : nullptr;
                const SplatLimits limits = limits_of(camera, s);
                const float rank = static_cast<float>(first + j);
                float sums[kSums] = {};
                if (s.low_pass_only != 0.0f) {
                    differentiate_pixels<kExtra, true>(camera, s, normal, limits, x, y, rank, 0, t, e, sums);
                } else {
                    differentiate_pixels<kExtra, false>(camera, s, normal, limits, x, y, rank, 0, t, e, sums);
                }
                const float sum = warp_sum16(sums, p.lane);
                if (p.lane < kSums) warp_sums[p.warp][j][p.lane] = sum;
            }
        }
        sync_block();
        for (int k = thread_index(); k < count * kSums; k += kTileThreads) {
            const int j = k / kSums, which = k % kSums;
            float sum = 0.0f;
            bool any_touched = false;
            for (int warp = 0; warp < kTileWarps; ++warp) {
                if (!(warp_touched[warp][j / kWarp] >> (j % kWarp) & 1u)) continue;
                sum += warp_sums[warp][j][which];
                any_touched = true;
            }
            if (!any_touched) continue;
            (&out.gradient[slots[j]].r)[which] = sum;
            if (which == 0) out.touched[slots[j]] = 1;
        }
    }
}

}  // namespace mass::device

namespace mass::gpu {

void blend_backward(const Call& call, const ImageData& images, const ImageGradient& gradient) {
    const Frame& f = call.frame;
    const Stream stream = static_cast<Stream>(call.stream);
    const ProjectedData projected{f.splats, f.normals, f.boxes, f.depth};
    const PairData pairs{f.tile_begin, f.pair_surfel_sorted, f.slot_begin};
    const PixelState state{f.transmittance, f.stop, f.median_rank, f.moments};
    const bool extra = gradient.normal || gradient.median || gradient.distortion;
    const PairSums sums{f.pair_gradient, extra, f.touched};
    fill_bytes(f.touched, 0, static_cast<std::size_t>(call.shape.capacity), stream);
    launch(extra ? device::differentiate_tiles<true> : device::differentiate_tiles<false>, tiles_of(call.shape), device::kTileThreads, stream,
           call.camera, projected, pairs, images, state, gradient, sums);
}

}  // namespace mass::gpu
