// Where a tile lies in the image, and where what is summed over it goes.
#pragma once

#include "simd.hpp"
#include "types.hpp"

namespace mass::MASS_ISA {

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

// Where the sums of this surfel over this tile go.
MASS_INLINE uint32_t slot_of(const PairData& pairs, uint32_t id, const Box& box, const TileWindow& w) {
    const int x0 = box.x0 / kTile, columns = box.x1 / kTile - x0 + 1;
    return pairs.slot_begin[id] + static_cast<uint32_t>((w.y / kTile - box.y0 / kTile) * columns + w.x / kTile - x0);
}

}  // namespace mass::MASS_ISA
