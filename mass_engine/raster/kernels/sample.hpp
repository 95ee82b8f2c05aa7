// One surfel at the sixteen pixels of a block: shared by the forward and the backward pass, so that both see the
// same bits.
#pragma once

#include "simd.hpp"
#include "types.hpp"

namespace mass::MASS_ISA {

struct Sample {
    F dx, dy;
    F pu, pv, pz, inverse_pz;  // not set for a low-pass-only splat
    M solid;                   // the 3-D part decides: rho3 <= rho2, met beyond the near plane; likewise
    M inclined;                // and the depth is that of the ray's meeting with the plane
    F rho, gaussian, alpha;
    M valid;  // strong enough to be blended
};

// What does not change from block to block.
struct SplatLimits {
    F largest_pz;  // beyond it the ray meets the plane before the near plane
    M ray_depth;   // all or none: depth where the ray meets the plane, or the centre's
};

MASS_INLINE SplatLimits limits_of(const CameraData& camera, const Splat& s) {
    return {splat(s.zc * camera.inverse_near), lt(splat(camera.center_depth ? 1.0f : -1.0f), splat(0.0f))};
}

// kLowPassOnly: the projection has found that rho2 < rho3 wherever the surfel reaches.
template <bool kLowPassOnly>
MASS_INLINE Sample sample(const Splat& s, const SplatLimits& limits, F x, F y) {
    Sample o;
    o.dx = sub(x, splat(s.mx));
    o.dy = sub(y, splat(s.my));
    o.rho = mul(splat(kLowPass), fma(o.dx, o.dx, mul(o.dy, o.dy)));
    if constexpr (!kLowPassOnly) {
        const F rho2 = o.rho;
        o.pz = fma(splat(s.g1), o.dx, fma(splat(s.g2), o.dy, splat(1.0f)));
        o.pu = fma(splat(s.a1), o.dx, mul(splat(s.a2), o.dy));
        o.pv = fma(splat(s.b1), o.dx, mul(splat(s.b2), o.dy));
        const F radius2 = fma(o.pu, o.pu, mul(o.pv, o.pv));
        o.solid = both(le(radius2, mul(rho2, mul(o.pz, o.pz))), both(lt(splat(0.0f), o.pz), le(o.pz, limits.largest_pz)));
        o.inclined = both(o.solid, limits.ray_depth);
        o.inverse_pz = rcp(o.pz);
        o.rho = select(o.solid, mul(radius2, mul(o.inverse_pz, o.inverse_pz)), rho2);
    }
    o.gaussian = exp2_neg(mul(o.rho, splat(-0.72134752f)));  // exp(-rho / 2)
    o.alpha = min(mul(splat(s.opacity), o.gaussian), splat(kAlphaMax));
    o.valid = le(splat(kAlphaCut), o.alpha);
    return o;
}

template <bool kLowPassOnly>
MASS_INLINE F depth_of(const Splat& s, const Sample& p) {
    if constexpr (kLowPassOnly) return splat(s.zc);
    return mul(splat(s.zc), select(p.inclined, p.inverse_pz, splat(1.0f)));
}

template <bool kLowPassOnly>
MASS_INLINE F inverse_depth_of(const Splat& s, const Sample& p) {
    const F inverse = splat(1.0f / s.zc);
    if constexpr (kLowPassOnly) return inverse;
    return mul(inverse, select(p.inclined, p.pz, splat(1.0f)));
}

// Pixel centres of the blocks of a tile.
struct TilePixels {
    alignas(64) float x[kTile / kBlock][kLanes], y[kTile / kBlock][kLanes];
};

MASS_INLINE void tile_pixels(int tile_x, int tile_y, TilePixels& p) {
    for (int b = 0; b < kTile / kBlock; ++b) {
        for (int l = 0; l < kLanes; ++l) {
            p.x[b][l] = static_cast<float>(tile_x * kTile + b * kBlock + l % kBlock) + 0.5f;
            p.y[b][l] = static_cast<float>(tile_y * kTile + b * kBlock + l / kBlock) + 0.5f;
        }
    }
}

// The part of a tile inside the image.
struct TileWindow {
    int x, y, width, height;
};

MASS_INLINE TileWindow tile_window(const CameraData& camera, int tile) {
    TileWindow w;
    w.x = tile % camera.tiles_x * kTile;
    w.y = tile / camera.tiles_x * kTile;
    w.width = camera.width - w.x < kTile ? camera.width - w.x : kTile;
    w.height = camera.height - w.y < kTile ? camera.height - w.y : kTile;
    return w;
}

inline constexpr unsigned kAllBlocks = 0xffffu;

// Which of the tile's 4 x 4 blocks the box meets: bit 4 * row + column.
MASS_INLINE unsigned block_mask(const Box& box, const TileWindow& w) {
    const int left = box.x0 - w.x, right = box.x1 - w.x, top = box.y0 - w.y, bottom = box.y1 - w.y;
    const int bx0 = (left > 0 ? left : 0) / kBlock, bx1 = (right < kTile ? right : kTile - 1) / kBlock;
    const int by0 = (top > 0 ? top : 0) / kBlock, by1 = (bottom < kTile ? bottom : kTile - 1) / kBlock;
    const unsigned columns = (2u << bx1) - (1u << bx0);
    const unsigned rows = ((16u << (4 * by1)) - (1u << (4 * by0))) & 0x1111u;  // one bit per row
    return columns * rows;
}

// Where the sums of this surfel over this tile go.
MASS_INLINE uint32_t slot_of(const PairData& pairs, uint32_t id, const Box& box, const TileWindow& w) {
    const int x0 = box.x0 / kTile, columns = box.x1 / kTile - x0 + 1;
    return pairs.slot_begin[id] + static_cast<uint32_t>((w.y / kTile - box.y0 / kTile) * columns + w.x / kTile - x0);
}

// Tiles keep each quantity block by block; images keep it row by row, `channels` interleaved.
MASS_INLINE int lane_of(int x, int y) { return (y / kBlock * (kTile / kBlock) + x / kBlock) * kLanes + y % kBlock * kBlock + x % kBlock; }

MASS_INLINE void write_tile(const CameraData& camera, const TileWindow& w, const float* tile, float* image, int channels, int channel) {
    for (int y = 0; y < w.height; ++y) {
        float* row = image + (static_cast<int64_t>(w.y + y) * camera.width + w.x) * channels + channel;
        for (int x = 0; x < w.width; ++x) row[x * channels] = tile[lane_of(x, y)];
    }
}

// Pixels outside the image read `outside`; a null image reads zero.
MASS_INLINE void read_tile(const CameraData& camera, const TileWindow& w, const float* image, int channels, int channel, float outside, float* tile) {
    for (int y = 0; y < kTile; ++y) {
        for (int x = 0; x < kTile; ++x) {
            const bool inside = x < w.width && y < w.height;
            const int64_t at = (static_cast<int64_t>(w.y + y) * camera.width + w.x + x) * channels + channel;
            tile[lane_of(x, y)] = !inside ? outside : image ? image[at] : 0.0f;
        }
    }
}

}  // namespace mass::MASS_ISA
