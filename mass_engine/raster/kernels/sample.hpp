// One surfel at the sixteen pixels of a block: shared by the forward and the backward pass, so that both see the
// same bits.
#pragma once

#include "simd.hpp"
#include "types.hpp"

namespace mass::MASS_ISA {

struct Sample {
    F dx, dy;
    F pu, pv, pz, inverse_pz;
    F rho, gaussian, alpha;
    M solid;  // the 3-D part decides (rho3 <= rho2, met beyond the near plane)
    M valid;  // strong enough to be blended
};

MASS_INLINE Sample sample(const Splat& s, F x, F y) {
    Sample o;
    const F one = splat(1.0f);
    o.dx = sub(x, splat(s.mx));
    o.dy = sub(y, splat(s.my));
    o.pz = fma(splat(s.g1), o.dx, fma(splat(s.g2), o.dy, one));
    o.pu = fma(splat(s.a1), o.dx, mul(splat(s.a2), o.dy));
    o.pv = fma(splat(s.b1), o.dx, mul(splat(s.b2), o.dy));
    const F radius2 = fma(o.pu, o.pu, mul(o.pv, o.pv));
    const F rho2 = mul(splat(kLowPass), fma(o.dx, o.dx, mul(o.dy, o.dy)));
    o.solid = both(le(radius2, mul(rho2, mul(o.pz, o.pz))), both(lt(splat(0.0f), o.pz), le(o.pz, splat(s.pz_max))));
    o.inverse_pz = rcp(o.pz);
    o.rho = select(o.solid, mul(radius2, mul(o.inverse_pz, o.inverse_pz)), rho2);
    o.gaussian = exp2_neg(mul(o.rho, splat(-0.72134752f)));  // exp(-rho / 2)
    o.alpha = min(mul(splat(s.opacity), o.gaussian), splat(kAlphaMax));
    o.valid = le(splat(kAlphaCut), o.alpha);
    return o;
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
