// Depth order and tile lists.
#pragma once

#include <stdexcept>

#include "buffer.hpp"
#include "thread_pool.hpp"
#include "types.hpp"

namespace mass {

struct TooManyPairs : std::runtime_error {
    using std::runtime_error::runtime_error;
};

// Buffers for sorting and binning one frame.
class Binning {
public:
    // Visible surfels by centre depth, then index: stable radix sort of `keys`. The result does not depend on `threads`.
    void sort(const uint32_t* keys, int count, ThreadPool& pool, int threads);

    // One entry per surfel and tile its box meets. Slots number the pairs surfel by surfel, in depth order.
    // Throws TooManyPairs at 2^31 pairs.
    void assign(const CameraData& camera, const Box* boxes, int count, bool with_slots, ThreadPool& pool, int threads);

    PairData pairs() const;
    int visible() const { return visible_; }
    uint32_t pair_count() const { return pair_count_; }
    const uint32_t* slot_begin() const { return slot_begin_.data(); }
    const uint32_t* slot_end() const { return slot_end_.data(); }
    std::size_t bytes() const;

private:
    Buffer<uint64_t> items_, swap_;
    Buffer<uint32_t> histograms_, tile_counts_, tile_begin_, surfel_, slot_, slot_begin_, slot_end_;
    Buffer<uint16_t> blocks_;
    const uint64_t* order_ = nullptr;
    int visible_ = 0;
    uint32_t pair_count_ = 0;
    bool with_slots_ = false;
};

}  // namespace mass
