#include "binning.hpp"

#include <algorithm>
#include <cstring>

namespace mass {

namespace {

constexpr int kDigitBits = 11;
constexpr uint32_t kDigits = 1u << kDigitBits;

struct Range {
    int begin, end;
};

Range part(int count, int parts, int index) {
    const int64_t n = count;
    return {static_cast<int>(n * index / parts), static_cast<int>(n * (index + 1) / parts)};
}

// Which of the tile's 4 x 4 blocks the box meets, bit by * 4 + bx.
uint16_t block_mask(const Box& box, int tile_x, int tile_y) {
    const int x = tile_x * kTile, y = tile_y * kTile;
    const int bx0 = std::max(box.x0 - x, 0) / kBlock, bx1 = std::min(box.x1 - x, kTile - 1) / kBlock;
    const int by0 = std::max(box.y0 - y, 0) / kBlock, by1 = std::min(box.y1 - y, kTile - 1) / kBlock;
    const unsigned columns = (2u << bx1) - (1u << bx0);
    const unsigned rows = ((16u << (4 * by1)) - (1u << (4 * by0))) & 0x1111u;  // one bit per row
    return static_cast<uint16_t>(columns * rows);
}

}  // namespace

void Binning::sort(const uint32_t* keys, int count, ThreadPool& pool, int threads) {
    const int parts = std::clamp(count / 4096, 1, threads);
    uint32_t* counts = histograms_.reserve(static_cast<std::size_t>(parts) * kDigits);
    uint64_t* from = items_.reserve(static_cast<std::size_t>(count));
    uint64_t* to = swap_.reserve(static_cast<std::size_t>(count));

    // Collect the visible ones; their depths usually span few bits.
    std::vector<uint32_t> seen(static_cast<std::size_t>(parts)), low(seen.size()), high(seen.size());
    pool.loop(parts, threads, [&](int p) {
        const Range r = part(count, parts, p);
        uint32_t n = 0, least = kCulled, most = 0;
        for (int i = r.begin; i < r.end; ++i) {
            if (keys[i] == kCulled) continue;
            ++n;
            least = std::min(least, keys[i]);
            most = std::max(most, keys[i]);
        }
        seen[static_cast<std::size_t>(p)] = n;
        low[static_cast<std::size_t>(p)] = least;
        high[static_cast<std::size_t>(p)] = most;
    });
    const uint32_t least = *std::min_element(low.begin(), low.end());
    const uint32_t most = *std::max_element(high.begin(), high.end());
    uint32_t total = 0;
    for (uint32_t& n : seen) {
        const uint32_t here = n;
        n = total;
        total += here;
    }
    visible_ = static_cast<int>(total);
    order_ = from;
    if (total == 0) return;
    pool.loop(parts, threads, [&](int p) {
        const Range r = part(count, parts, p);
        uint64_t* out = from + seen[static_cast<std::size_t>(p)];
        for (int i = r.begin; i < r.end; ++i) {
            if (keys[i] != kCulled) *out++ = static_cast<uint64_t>(keys[i] - least) << 32 | static_cast<uint32_t>(i);
        }
    });

    for (int shift = 0; shift < 32 && (most - least) >> shift != 0; shift += kDigitBits) {
        const int at = 32 + shift;
        pool.loop(parts, threads, [&](int p) {
            const Range r = part(visible_, parts, p);
            uint32_t* mine = counts + static_cast<std::size_t>(p) * kDigits;
            std::memset(mine, 0, kDigits * sizeof(uint32_t));
            for (int i = r.begin; i < r.end; ++i) ++mine[from[i] >> at & (kDigits - 1)];
        });
        uint32_t sum = 0;
        for (uint32_t digit = 0; digit < kDigits; ++digit) {
            for (int p = 0; p < parts; ++p) {
                uint32_t& slot = counts[static_cast<std::size_t>(p) * kDigits + digit];
                const uint32_t here = slot;
                slot = sum;
                sum += here;
            }
        }
        pool.loop(parts, threads, [&](int p) {
            const Range r = part(visible_, parts, p);
            uint32_t* mine = counts + static_cast<std::size_t>(p) * kDigits;
            for (int i = r.begin; i < r.end; ++i) to[mine[from[i] >> at & (kDigits - 1)]++] = from[i];
        });
        std::swap(from, to);
    }
    order_ = from;
}

void Binning::assign(const CameraData& camera, const Box* boxes, int count, bool with_slots, ThreadPool& pool, int threads) {
    const int parts = std::clamp(visible_ / 4096, 1, threads);
    const std::size_t tiles = static_cast<std::size_t>(camera.tiles_x) * static_cast<std::size_t>(camera.tiles_y);
    uint32_t* counts = tile_counts_.reserve(static_cast<std::size_t>(parts) * tiles);
    uint32_t* begin = tile_begin_.reserve(tiles + 1);
    std::vector<uint64_t> totals(static_cast<std::size_t>(parts));
    pool.loop(parts, threads, [&](int p) {
        const Range r = part(visible_, parts, p);
        uint32_t* mine = counts + static_cast<std::size_t>(p) * tiles;
        std::memset(mine, 0, tiles * sizeof(uint32_t));
        uint64_t n = 0;
        for (int i = r.begin; i < r.end; ++i) {
            const Box box = boxes[static_cast<uint32_t>(order_[i])];
            const int x0 = box.x0 / kTile, x1 = box.x1 / kTile, y1 = box.y1 / kTile;
            for (int y = box.y0 / kTile; y <= y1; ++y) {
                for (int x = x0; x <= x1; ++x) ++mine[y * camera.tiles_x + x];
            }
            n += static_cast<uint64_t>(x1 - x0 + 1) * static_cast<uint64_t>(y1 - box.y0 / kTile + 1);
        }
        totals[static_cast<std::size_t>(p)] = n;
    });
    uint64_t total = 0;
    for (uint64_t& n : totals) {
        const uint64_t here = n;
        n = total;
        total += here;
    }
    if (total >= 1ull << 31) throw TooManyPairs("2^31 or more pairs of surfel and tile");
    pair_count_ = static_cast<uint32_t>(total);
    uint32_t sum = 0;
    for (std::size_t tile = 0; tile < tiles; ++tile) {
        begin[tile] = sum;
        for (int p = 0; p < parts; ++p) {
            uint32_t& slot = counts[static_cast<std::size_t>(p) * tiles + tile];
            const uint32_t here = slot;
            slot = sum;
            sum += here;
        }
    }
    begin[tiles] = sum;

    uint32_t* surfel = surfel_.reserve(total);
    uint16_t* blocks = blocks_.reserve(total);
    with_slots_ = with_slots;
    uint32_t* slot = nullptr;
    uint32_t *first_slot = nullptr, *last_slot = nullptr;
    if (with_slots) {
        slot = slot_.reserve(total);
        first_slot = slot_begin_.reserve(static_cast<std::size_t>(count));
        last_slot = slot_end_.reserve(static_cast<std::size_t>(count));
        std::memset(first_slot, 0, static_cast<std::size_t>(count) * sizeof(uint32_t));
        std::memset(last_slot, 0, static_cast<std::size_t>(count) * sizeof(uint32_t));
    }
    pool.loop(parts, threads, [&](int p) {
        const Range r = part(visible_, parts, p);
        uint32_t* mine = counts + static_cast<std::size_t>(p) * tiles;
        uint32_t next = static_cast<uint32_t>(totals[static_cast<std::size_t>(p)]);
        for (int i = r.begin; i < r.end; ++i) {
            const uint32_t id = static_cast<uint32_t>(order_[i]);
            const Box box = boxes[id];
            const int x0 = box.x0 / kTile, x1 = box.x1 / kTile, y1 = box.y1 / kTile;
            if (with_slots) first_slot[id] = next;
            for (int y = box.y0 / kTile; y <= y1; ++y) {
                for (int x = x0; x <= x1; ++x) {
                    const uint32_t at = mine[y * camera.tiles_x + x]++;
                    surfel[at] = id;
                    blocks[at] = block_mask(box, x, y);
                    if (with_slots) slot[at] = next++;
                }
            }
            if (with_slots) last_slot[id] = next;
        }
    });
}

PairData Binning::pairs() const {
    return {tile_begin_.data(), surfel_.data(), blocks_.data(), with_slots_ ? slot_.data() : nullptr};
}

std::size_t Binning::bytes() const {
    return items_.bytes() + swap_.bytes() + histograms_.bytes() + tile_counts_.bytes() + tile_begin_.bytes() +
           surfel_.bytes() + slot_.bytes() + slot_begin_.bytes() + slot_end_.bytes() + blocks_.bytes();
}

}  // namespace mass
