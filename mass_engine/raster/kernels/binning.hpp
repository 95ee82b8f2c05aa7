// Tile lists in depth order.
#pragma once

#include <stdexcept>

#include "buffer.hpp"
#include "thread_pool.hpp"
#include "types.hpp"

namespace mass {

struct TooManyPairs : std::runtime_error {
    using std::runtime_error::runtime_error;
};

// Buffers for listing one frame's surfels tile by tile. Surfels are listed in index order first, which reads and writes
// memory in order, then each tile sorts its own short list while it is in the nearest cache. Neither result depends on
// the number of threads.
class Binning {
public:
    // One entry per surfel and tile its box meets. Throws TooManyPairs at 2^31 pairs.
    void assign(const CameraData& camera, const Box* boxes, const uint32_t* keys, int count, bool with_slots,
                ThreadPool& pool, int threads);

    // Orders one tile's list by key, then index. Tiles are independent of each other.
    void sort(int tile, bool by_comparison);

    PairData pairs() const;
    uint32_t pair_count() const { return pair_count_; }
    const uint32_t* slot_begin() const { return slot_begin_.data(); }
    std::size_t bytes() const;

private:
    Buffer<uint64_t> items_, swap_;  // key in the high half, surfel in the low half
    Buffer<uint32_t> tile_counts_, tile_begin_, surfel_, slot_begin_;
    uint32_t pair_count_ = 0;
    bool with_slots_ = false;
};

}  // namespace mass
