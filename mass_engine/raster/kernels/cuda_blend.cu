// Front to back over the tiles: the forward pass.
#define MASS_ISA device
#define MASS_WIDTH 0
#include "blend_pixels.hpp"
#include "cuda_surfel.hpp"
#include "cuda_tile.hpp"

namespace mass::device {

constexpr int kBatch = 256;  // surfels in shared memory at a time

MASS_DEVICE void write_pixel(const PixelPlace& p, float x, float* image, int channels, int channel) {
    image[p.at * channels + channel] = x;
}

template <bool kExtra>
MASS_DEVICE void write_pixels(const PixelPlace& p, TileForward& t, const TileForwardExtra& e, const ImageData& out, const PixelState& state) {
    if (!p.inside) return;
    const float alpha = finish_pixels(t, 0);
    write_pixel(p, t.r[0][0], out.rgb, 3, 0);
    write_pixel(p, t.g[0][0], out.rgb, 3, 1);
    write_pixel(p, t.b[0][0], out.rgb, 3, 2);
    write_pixel(p, alpha, out.alpha, 1, 0);
    write_pixel(p, t.depth[0][0], out.depth, 1, 0);
    if constexpr (kExtra) {
        write_pixel(p, e.median[0][0], out.median, 1, 0);
        write_pixel(p, e.nx[0][0], out.normal, 3, 0);
        write_pixel(p, e.ny[0][0], out.normal, 3, 1);
        write_pixel(p, e.nz[0][0], out.normal, 3, 2);
        write_pixel(p, e.distortion[0][0], out.distortion, 1, 0);
    }
    if (!state.stop) return;
    write_pixel(p, t.transmittance[0][0], state.transmittance, 1, 0);
    write_pixel(p, t.stop[0][0], state.stop, 1, 0);
    if constexpr (kExtra) {
        write_pixel(p, e.median_rank[0][0], state.median_rank, 1, 0);
        write_pixel(p, e.q0[0][0], state.moments, 3, 0);
        write_pixel(p, e.m1[0][0], state.moments, 3, 1);
        write_pixel(p, e.m2[0][0], state.moments, 3, 2);
    }
}

// With extras, the sums of weights are taken too.
template <bool kExtra>
MASS_KERNEL(kTileThreads)
blend_tiles(CameraData camera, ProjectedData in, PairData pairs, ImageData out, PixelState state, float* slot_weights) {
    MASS_SHARED Splat splats[kBatch];
    MASS_SHARED Normal normals[kExtra ? kBatch : 1];
    MASS_SHARED float weights[kExtra ? kTileWarps : 1][kBatch];
    const int tile = block_index();
    const TileWindow window = tile_window(camera, tile);
    const PixelPlace p = pixel_place(camera, window);
    const float x = static_cast<float>(p.x) + 0.5f, y = static_cast<float>(p.y) + 0.5f;
    const uint32_t begin = pairs.tile_begin[tile], end = pairs.tile_begin[tile + 1];
    TileForward t{};
    TileForwardExtra e{};
    t.transmittance[0][0] = p.inside ? 1.0f : -1.0f;
    t.stop[0][0] = static_cast<float>(end - begin);
    e.median_rank[0][0] = -1.0f;

    bool going_on = warp_any(p.inside);
    for (uint32_t first = begin; first < end; first += kBatch) {
        if (!sync_block_or(going_on)) break;
        const int count = end - first < kBatch ? static_cast<int>(end - first) : kBatch;
        fetch(in.splats, pairs.surfel + first, count, splats);
        if constexpr (kExtra) {
            fetch(in.normals, pairs.surfel + first, count, normals);
            for (int j = p.lane; j < kBatch; j += kWarp) weights[p.warp][j] = 0.0f;
        }
        sync_block();
        for (int group = 0; group < count && going_on; group += kWarp) {
            const int mine = group + p.lane;
            unsigned todo = warp_ballot(mine < count && near_warp(splats[mine < count ? mine : 0].box, p));
            while (todo != 0) {
                const int j = group + lowest_bit(todo);
                todo &= todo - 1;
                const Splat& s = splats[j];
                const Normal* normal = kExtra ? normals + j : nullptr;
                const SplatLimits limits = limits_of(camera, s);
                const float rank = static_cast<float>(first - begin + static_cast<uint32_t>(j));
                const Blended b = s.low_pass_only != 0.0f ? blend_pixels<kExtra, true>(camera, s, normal, limits, x, y, rank, 0, t, e)
                                                          : blend_pixels<kExtra, false>(camera, s, normal, limits, x, y, rank, 0, t, e);
                if constexpr (kExtra) {
                    const float sum = warp_sum(b.weight);
                    if (p.lane == 0) weights[p.warp][j] = sum;
                }
            }
            going_on = warp_any(t.transmittance[0][0] > 0.0f);
        }
        if constexpr (kExtra) {
            sync_block();
            for (int j = thread_index(); j < count; j += kTileThreads) {
                float sum = 0.0f;
                for (int warp = 0; warp < kTileWarps; ++warp) sum += weights[warp][j];
                slot_weights[slot_of(pairs, pairs.surfel[first + static_cast<uint32_t>(j)], splats[j].box, window)] = sum;
            }
        }
    }
    write_pixels<kExtra>(p, t, e, out, state);
}

MASS_KERNEL(gpu::kSurfelThreads) sum_weights(gpu::Frame frame, int surfels, int capacity, float* weights) {
    const int i = block_index() * gpu::kSurfelThreads + thread_index();
    if (i >= surfels) return;
    const Slots slots = slots_of(frame, capacity, i);
    float sum = 0.0f;
    for (uint32_t slot = slots.begin; slot < slots.end; ++slot) sum += frame.slot_weights[slot];
    weights[i] = sum;
}

}  // namespace mass::device

namespace mass::gpu {

void blend(const Call& call, const ImageData& images, float* weights) {
    const Frame& f = call.frame;
    const Stream stream = static_cast<Stream>(call.stream);
    const ProjectedData projected{f.splats, f.normals, f.boxes, f.depth};
    const PairData pairs{f.tile_begin, f.pair_surfel_sorted, f.slot_begin};
    const PixelState state{f.transmittance, f.stop, f.median_rank, f.moments};
    const int tiles = tiles_of(call.shape);
    if (!call.shape.extra) {
        launch(device::blend_tiles<false>, tiles, device::kTileThreads, stream, call.camera, projected, pairs, images, state,
               static_cast<float*>(nullptr));
        return;
    }
    fill_bytes(f.slot_weights, 0, sizeof(float) * static_cast<std::size_t>(call.shape.capacity), stream);
    launch(device::blend_tiles<true>, tiles, device::kTileThreads, stream, call.camera, projected, pairs, images, state, f.slot_weights);
    launch(device::sum_weights, surfel_blocks(call.shape.surfels), kSurfelThreads, stream, f, call.shape.surfels, call.shape.capacity,
           weights);
}

}  // namespace mass::gpu
