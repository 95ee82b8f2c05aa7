// A block of threads for a tile, a thread for a pixel, a warp for 8 x 4 pixels: hand surfels are a few pixels wide, so
// each warp first asks, a surfel to a lane, which ones come near its own pixels.
#pragma once

#include "device.hpp"

#include "tile.hpp"

namespace mass::device {

inline constexpr int kTileThreads = kTile * kTile;
inline constexpr int kTileWarps = kTileThreads / kWarp;
inline constexpr int kWarpWidth = 8, kWarpHeight = 4;

// The thread's place in the tile and in the image.
struct PixelPlace {
    int warp, lane;
    int left, top;  // of the warp's pixels
    int x, y;
    bool inside;
    int64_t at;  // row-major index
};

MASS_DEVICE PixelPlace pixel_place(const CameraData& camera, const TileWindow& window) {
    PixelPlace p;
    const int thread = thread_index();
    p.warp = thread / kWarp;
    p.lane = thread % kWarp;
    p.left = window.x + p.warp % (kTile / kWarpWidth) * kWarpWidth;
    p.top = window.y + p.warp / (kTile / kWarpWidth) * kWarpHeight;
    p.x = p.left + p.lane % kWarpWidth;
    p.y = p.top + p.lane / kWarpWidth;
    p.inside = p.x < camera.width && p.y < camera.height;
    p.at = static_cast<int64_t>(p.y) * camera.width + p.x;
    return p;
}

// Does the box meet the warp's pixels?
MASS_DEVICE bool near_warp(const Box& b, const PixelPlace& p) {
    return b.x0 < p.left + kWarpWidth && b.x1 >= p.left && b.y0 < p.top + kWarpHeight && b.y1 >= p.top;
}

struct __attribute__((may_alias, aligned(16))) Quad {
    float x[4];
};

// Copies rows ids[0 .. count-1] to shared memory, by all threads of a tile.
template <typename T>
MASS_DEVICE void fetch(const T* from, const uint32_t* ids, int count, T* to) {
    constexpr int kQuads = sizeof(T) / sizeof(Quad);
    for (int k = thread_index(); k < count * kQuads; k += kTileThreads) {
        reinterpret_cast<Quad*>(to)[k] = reinterpret_cast<const Quad*>(from + ids[k / kQuads])[k % kQuads];
    }
}

MASS_DEVICE float warp_sum(float x) {
    for (int mask = kWarp / 2; mask > 0; mask /= 2) x += warp_xor(x, mask);
    return x;
}

// In lane l: the sum of x[l % 16] over the warp. Each round halves the values a lane keeps and doubles the lanes they
// stand for: 16 exchanges instead of 80.
MASS_DEVICE float warp_sum16(const float* x, int lane) {
    float a[8], b[4], c[2];
    for (int k = 0; k < 8; ++k) a[k] = (lane & 8 ? x[8 + k] : x[k]) + warp_xor(lane & 8 ? x[k] : x[8 + k], 8);
    for (int k = 0; k < 4; ++k) b[k] = (lane & 4 ? a[4 + k] : a[k]) + warp_xor(lane & 4 ? a[k] : a[4 + k], 4);
    for (int k = 0; k < 2; ++k) c[k] = (lane & 2 ? b[2 + k] : b[k]) + warp_xor(lane & 2 ? b[k] : b[2 + k], 2);
    const float d = (lane & 1 ? c[1] : c[0]) + warp_xor(lane & 1 ? c[0] : c[1], 1);
    return d + warp_xor(d, 16);
}

}  // namespace mass::device
