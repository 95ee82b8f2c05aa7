// The (surfel, tile) pairs, grouped by tile, nearest first, ties by index.
#define MASS_ISA device
#define MASS_WIDTH 0
#include "cuda_surfel.hpp"

namespace mass::device {

// tiles[r]: how many the r-th nearest surfel meets; zero at the end, so that the sums before end with the total.
MASS_KERNEL(gpu::kSurfelThreads) count_pairs(gpu::Frame frame, int surfels) {
    const int r = block_index() * gpu::kSurfelThreads + thread_index();
    if (r > surfels) return;
    frame.tiles[r] = r < surfels ? static_cast<uint64_t>(count_tiles(frame.boxes[frame.order[r]])) : 0;
}

MASS_KERNEL(gpu::kSurfelThreads) write_pairs(gpu::Frame frame, int surfels, int capacity, int tiles_x, int* counters) {
    const int r = block_index() * gpu::kSurfelThreads + thread_index();
    const uint64_t room = static_cast<uint64_t>(capacity);
    if (r == surfels) {
        const uint64_t total = frame.tiles_before[surfels];
        counters[gpu::kPairs] = static_cast<int>(total < 0x7fffffffu ? total : 0x7fffffffu);
        if (total > room) atomic_or(counters + gpu::kStatus, gpu::kOverflow);
    }
    if (r >= surfels) return;
    const uint32_t id = frame.order[r];
    const Box box = frame.boxes[id];
    uint64_t slot = frame.tiles_before[r];
    frame.slot_begin[id] = static_cast<uint32_t>(slot < room ? slot : room);
    if (box.x1 < box.x0) return;
    for (int y = box.y0 / kTile; y <= box.y1 / kTile; ++y) {
        for (int x = box.x0 / kTile; x <= box.x1 / kTile && slot < room; ++x, ++slot) {
            frame.pair_tile[slot] = static_cast<uint32_t>(y * tiles_x + x);
            frame.pair_surfel[slot] = id;
        }
    }
}

// tile_begin[t]: the first pair whose tile is t or later. Unused pairs have the largest number there is.
MASS_KERNEL(gpu::kSurfelThreads) find_tiles(gpu::Frame frame, int tiles, int capacity) {
    const int tile = block_index() * gpu::kSurfelThreads + thread_index();
    if (tile > tiles) return;
    int begin = 0, end = capacity;
    while (begin < end) {
        const int middle = begin + (end - begin) / 2;
        if (frame.pair_tile_sorted[middle] < static_cast<uint32_t>(tile)) {
            begin = middle + 1;
        } else {
            end = middle;
        }
    }
    frame.tile_begin[tile] = static_cast<uint32_t>(begin);
}

}  // namespace mass::device

namespace mass::gpu {

void list_pairs(const Call& call, int* counters) {
    const Frame& f = call.frame;
    const Stream stream = static_cast<Stream>(call.stream);
    const int surfels = call.shape.surfels, capacity = call.shape.capacity, tiles = tiles_of(call.shape);
    sort_by_key(call, f.depth, f.depth_sorted, f.index, f.order, surfels, 32);
    launch(device::count_pairs, surfel_blocks(surfels + 1), kSurfelThreads, stream, f, surfels);
    sum_before(call, f.tiles, f.tiles_before, surfels + 1);
    fill_bytes(f.pair_tile, 0xff, sizeof(uint32_t) * static_cast<std::size_t>(capacity), stream);
    launch(device::write_pairs, surfel_blocks(surfels + 1), kSurfelThreads, stream, f, surfels, capacity, call.camera.tiles_x, counters);
    int bits = 1;  // `tiles` and all ones differ from every tile's number in them
    while (tiles >> bits != 0) ++bits;
    sort_by_key(call, f.pair_tile, f.pair_tile_sorted, f.pair_surfel, f.pair_surfel_sorted, capacity, bits);
    launch(device::find_tiles, surfel_blocks(tiles + 1), kSurfelThreads, stream, f, tiles, capacity);
}

}  // namespace mass::gpu
