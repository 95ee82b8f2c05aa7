// The structural loss of a fit, forward and backward, each in one pass over the pictures: a block per tile, its
// surroundings in shared memory, the window's sums by rows, then by columns. Beyond the picture everything is zero.
#define MASS_ISA device
#define MASS_WIDTH 0
#include "device.hpp"

#include "passes.hpp"
#include "ssim.hpp"

namespace mass::device {

inline constexpr int kTile2 = gpu::kSsimTile * gpu::kSsimTile;
inline constexpr int kWide = gpu::kSsimTile + 2 * kSsimReach;  // a tile with its surroundings
inline constexpr float kEach = 1.0f / (2 * kSsimReach + 1);    // weight of a pixel in a row or column of the window

struct Place {
    int x0, y0, x, y;  // of the tile, and of the thread's pixel
    bool drawn;
};

MASS_DEVICE Place place_of(int height, int width) {
    const int across = (width + gpu::kSsimTile - 1) / gpu::kSsimTile;
    Place p;
    p.x0 = block_index() % across * gpu::kSsimTile;
    p.y0 = block_index() / across * gpu::kSsimTile;
    p.x = p.x0 + thread_index() % gpu::kSsimTile;
    p.y = p.y0 + thread_index() / gpu::kSsimTile;
    p.drawn = p.x < width && p.y < height;
    return p;
}

MASS_DEVICE float grey(const float* picture, int64_t pixel) {
    return (picture[3 * pixel] + picture[3 * pixel + 1] + picture[3 * pixel + 2]) * (1.0f / 3.0f);
}

// sum[planes] over the window's columns of what `rows` holds of a tile's rows: [kWide][kSsimTile] a plane.
template <int planes>
MASS_DEVICE void sum_columns(const float (&rows)[planes][kWide][gpu::kSsimTile], float (&sum)[planes]) {
    const int x = thread_index() % gpu::kSsimTile, y = thread_index() / gpu::kSsimTile;
    for (int p = 0; p < planes; ++p) {
        float s = 0.0f;
        for (int k = 0; k <= 2 * kSsimReach; ++k) s += rows[p][y + k][x];
        sum[p] = s * kEach;
    }
}

MASS_KERNEL(kTile2) compare(gpu::Pictures in, float* sums, float* slopes) {
    MASS_SHARED float x[kWide][kWide], y[kWide][kWide];
    MASS_SHARED float rows[5][kWide][gpu::kSsimTile];
    MASS_SHARED float totals[2][kTile2];
    const Place place = place_of(in.height, in.width);
    for (int k = thread_index(); k < kWide * kWide; k += kTile2) {
        const int row = k / kWide, column = k % kWide;
        const int py = place.y0 + row - kSsimReach, px = place.x0 + column - kSsimReach;
        const bool in_picture = py >= 0 && py < in.height && px >= 0 && px < in.width;
        const int64_t pixel = static_cast<int64_t>(py) * in.width + px;
        x[row][column] = in_picture ? grey(in.seen, pixel) : 0.0f;
        y[row][column] = in_picture ? grey(in.wanted, pixel) : 0.0f;
    }
    sync_block();
    for (int k = thread_index(); k < kWide * gpu::kSsimTile; k += kTile2) {
        const int row = k / gpu::kSsimTile, column = k % gpu::kSsimTile;
        float sum[5] = {0.0f, 0.0f, 0.0f, 0.0f, 0.0f};
        for (int o = 0; o <= 2 * kSsimReach; ++o) {
            const float a = x[row][column + o], b = y[row][column + o];
            sum[0] += a, sum[1] += b, sum[2] += a * a, sum[3] += b * b, sum[4] += a * b;
        }
        for (int p = 0; p < 5; ++p) rows[p][row][column] = sum[p] * kEach;
    }
    sync_block();
    float mean[5];
    sum_columns<5>(rows, mean);
    const int64_t pixel = static_cast<int64_t>(place.y) * in.width + place.x, size = static_cast<int64_t>(in.height) * in.width;
    const float counts = place.drawn ? in.inside[pixel] : 0.0f;
    const Dissimilarity d = dissimilarity({mean[0], mean[1], mean[2], mean[3], mean[4]});
    if (place.drawn && slopes != nullptr) {
        slopes[pixel] = d.d_x * counts;
        slopes[size + pixel] = d.d_xx * counts;
        slopes[2 * size + pixel] = d.d_xy * counts;
    }
    const int t = thread_index();
    totals[0][t] = d.value * counts;
    totals[1][t] = counts;
    for (int half = kTile2 / 2; half > 0; half /= 2) {
        sync_block();
        if (t < half) totals[0][t] += totals[0][t + half], totals[1][t] += totals[1][t + half];
    }
    if (t == 0) sums[2 * block_index()] = totals[0][0], sums[2 * block_index() + 1] = totals[1][0];
}

MASS_KERNEL(kTile2) compare_backward(gpu::Pictures in, const float* slopes, const float* scale, float* d_seen) {
    MASS_SHARED float wide[3][kWide][kWide];
    MASS_SHARED float rows[3][kWide][gpu::kSsimTile];
    const Place place = place_of(in.height, in.width);
    const int64_t size = static_cast<int64_t>(in.height) * in.width;
    for (int k = thread_index(); k < kWide * kWide; k += kTile2) {
        const int row = k / kWide, column = k % kWide;
        const int py = place.y0 + row - kSsimReach, px = place.x0 + column - kSsimReach;
        const bool in_picture = py >= 0 && py < in.height && px >= 0 && px < in.width;
        const int64_t pixel = static_cast<int64_t>(py) * in.width + px;
        for (int p = 0; p < 3; ++p) wide[p][row][column] = in_picture ? slopes[p * size + pixel] : 0.0f;
    }
    sync_block();
    for (int k = thread_index(); k < kWide * gpu::kSsimTile; k += kTile2) {
        const int row = k / gpu::kSsimTile, column = k % gpu::kSsimTile;
        for (int p = 0; p < 3; ++p) {
            float sum = 0.0f;
            for (int o = 0; o <= 2 * kSsimReach; ++o) sum += wide[p][row][column + o];
            rows[p][row][column] = sum * kEach;
        }
    }
    sync_block();
    float sum[3];
    sum_columns<3>(rows, sum);
    if (!place.drawn) return;
    const int64_t pixel = static_cast<int64_t>(place.y) * in.width + place.x;
    const float x = grey(in.seen, pixel), y = grey(in.wanted, pixel);
    const float d = *scale * (1.0f / 3.0f) * (sum[0] + 2.0f * x * sum[1] + y * sum[2]);
    for (int c = 0; c < 3; ++c) d_seen[3 * pixel + c] = d;
}

}  // namespace mass::device

namespace mass::gpu {

void ssim(const Pictures& p, float* sums, float* slopes, int device, void* stream) {
    const DeviceGuard guard(device);
    launch(device::compare, ssim_blocks(p.height, p.width), device::kTile2, static_cast<Stream>(stream), p, sums, slopes);
}

void ssim_backward(const Pictures& p, const float* slopes, const float* scale, float* d_seen, int device, void* stream) {
    const DeviceGuard guard(device);
    launch(device::compare_backward, ssim_blocks(p.height, p.width), device::kTile2, static_cast<Stream>(stream), p, slopes, scale, d_seen);
}

}  // namespace mass::gpu
