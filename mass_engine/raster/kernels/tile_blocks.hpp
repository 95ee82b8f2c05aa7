// A tile as 4 x 4 blocks of one vector each.
#pragma once

#include "tile.hpp"

namespace mass::MASS_ISA {

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
