#include "binning.hpp"

#include <algorithm>
#include <cstring>

namespace mass {

namespace {

constexpr int kDigitBits = 8;
constexpr uint32_t kDigits = 1u << kDigitBits;
constexpr uint32_t kInsertion = 24;  // lists up to this long are sorted by insertion

// Fewer surfels than this per thread are not worth sharing.
constexpr int kLeastShare = 4096;

struct Range {
    int begin, end;
};

Range part(int count, int parts, int index) {
    const int64_t n = count;
    return {static_cast<int>(n * index / parts), static_cast<int>(n * (index + 1) / parts)};
}

// Calls visit(tile) for each tile the box meets, row by row; an empty box meets none.
template <typename Visit>
inline void for_each_tile(const CameraData& camera, const Box& box, Visit visit) {
    if (box.x1 < box.x0) return;
    const int x0 = box.x0 / kTile, x1 = box.x1 / kTile, y1 = box.y1 / kTile;
    for (int y = box.y0 / kTile; y <= y1; ++y) {
        for (int x = x0; x <= x1; ++x) visit(y * camera.tiles_x + x);
    }
}

}  // namespace

void Binning::assign(const CameraData& camera, const Box* boxes, const uint32_t* keys, int count, bool with_slots,
                     ThreadPool& pool, int threads) {
    const int parts = std::clamp(count / kLeastShare, 1, threads);
    const std::size_t tiles = static_cast<std::size_t>(camera.tiles_x) * static_cast<std::size_t>(camera.tiles_y);
    uint32_t* counts = tile_counts_.reserve(static_cast<std::size_t>(parts) * tiles);
    uint32_t* begin = tile_begin_.reserve(tiles + 1);
    std::vector<uint64_t> totals(static_cast<std::size_t>(parts));
    pool.loop(parts, threads, [&](int p) {
        const Range r = part(count, parts, p);
        uint32_t* mine = counts + static_cast<std::size_t>(p) * tiles;
        std::memset(mine, 0, tiles * sizeof(uint32_t));
        uint64_t n = 0;
        for (int i = r.begin; i < r.end; ++i) {
            for_each_tile(camera, boxes[i], [&](int tile) {
                ++mine[tile];
                ++n;
            });
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
            uint32_t& next = counts[static_cast<std::size_t>(p) * tiles + tile];
            const uint32_t here = next;
            next = sum;
            sum += here;
        }
    }
    begin[tiles] = sum;

    uint64_t* items = items_.reserve(total);
    swap_.reserve(total);
    surfel_.reserve(total);
    with_slots_ = with_slots;
    uint32_t* slot_begin = with_slots ? slot_begin_.reserve(static_cast<std::size_t>(count) + 1) : nullptr;
    pool.loop(parts, threads, [&](int p) {
        const Range r = part(count, parts, p);
        uint32_t* next = counts + static_cast<std::size_t>(p) * tiles;
        uint32_t slot = static_cast<uint32_t>(totals[static_cast<std::size_t>(p)]);
        for (int i = r.begin; i < r.end; ++i) {
            if (slot_begin) slot_begin[i] = slot;
            const uint64_t item = static_cast<uint64_t>(keys[i]) << 32 | static_cast<uint32_t>(i);
            for_each_tile(camera, boxes[i], [&](int tile) {
                items[next[tile]++] = item;
                ++slot;
            });
        }
    });
    if (slot_begin) slot_begin[count] = pair_count_;
}

void Binning::sort(int tile, bool by_comparison) {
    const uint32_t begin = tile_begin_.data()[tile], n = tile_begin_.data()[tile + 1] - begin;
    uint64_t *from = items_.data() + begin, *to = swap_.data() + begin;
    uint32_t* out = surfel_.data() + begin;
    if (by_comparison) {
        std::sort(from, from + n);
    } else if (n <= kInsertion) {
        for (uint32_t i = 1; i < n; ++i) {
            const uint64_t item = from[i];
            uint32_t j = i;
            for (; j > 0 && from[j - 1] > item; --j) from[j] = from[j - 1];
            from[j] = item;
        }
    } else {
        // A tile's depths share their leading bits: only the rest is sorted, least significant digit first.
        uint64_t least = from[0], most = from[0];
        for (uint32_t i = 1; i < n; ++i) {
            least = std::min(least, from[i]);
            most = std::max(most, from[i]);
        }
        const uint64_t base = least >> 32 << 32;
        for (int shift = 32; shift < 64 && (most - base) >> shift != 0; shift += kDigitBits) {
            uint32_t next[kDigits] = {};
            for (uint32_t i = 0; i < n; ++i) ++next[(from[i] - base) >> shift & (kDigits - 1)];
            uint32_t sum = 0;
            for (uint32_t& x : next) {
                const uint32_t here = x;
                x = sum;
                sum += here;
            }
            for (uint32_t i = 0; i < n; ++i) to[next[(from[i] - base) >> shift & (kDigits - 1)]++] = from[i];
            std::swap(from, to);
        }
    }
    for (uint32_t i = 0; i < n; ++i) out[i] = static_cast<uint32_t>(from[i]);
}

PairData Binning::pairs() const {
    return {tile_begin_.data(), surfel_.data(), with_slots_ ? slot_begin_.data() : nullptr};
}

std::size_t Binning::bytes() const {
    return items_.bytes() + swap_.bytes() + tile_counts_.bytes() + tile_begin_.bytes() + surfel_.bytes() + slot_begin_.bytes();
}

}  // namespace mass
