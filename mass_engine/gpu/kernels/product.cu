// A fixed sparse matrix times a dense one: the lookup in a hash grid, whose points never move, and the subdivision of a
// mesh. The gradient is the same with the transpose.
#define MASS_ISA device
#define MASS_WIDTH 0
#include "device.hpp"

#include "one_lane.hpp"
#include "passes.hpp"

namespace mass::device {

inline constexpr int kThreads = 128;
inline constexpr int kChannels = 4;  // a warp sums at a time

MASS_KERNEL(kThreads) multiply_few(gpu::Rows m, const float* dense, int channels, float* out) {
    const int64_t at = static_cast<int64_t>(block_index()) * kThreads + thread_index();
    const int row = static_cast<int>(at / channels), channel = static_cast<int>(at % channels);
    if (row >= m.count) return;
    F sum = 0.0f;
    for (int k = m.begins[row]; k < m.begins[row + 1]; ++k) {
        sum = fma(m.values[k], dense[static_cast<int64_t>(m.columns[k]) * channels + channel], sum);
    }
    out[at] = sum;
}

MASS_KERNEL(kThreads) multiply_many(gpu::Rows m, const float* dense, int channels, float* out) {
    const int row = block_index() * (kThreads / kWarp) + thread_index() / kWarp, lane = thread_index() % kWarp;
    if (row >= m.count) return;  // the whole warp
    for (int first = 0; first < channels; first += kChannels) {
        F sum[kChannels] = {};
        const int some = channels - first < kChannels ? channels - first : kChannels;
        for (int k = m.begins[row] + lane; k < m.begins[row + 1]; k += kWarp) {
            const float* from = dense + static_cast<int64_t>(m.columns[k]) * channels + first;
            for (int c = 0; c < some; ++c) sum[c] = fma(m.values[k], from[c], sum[c]);
        }
        for (int c = 0; c < some; ++c) {
            for (int mask = kWarp / 2; mask > 0; mask /= 2) sum[c] = add(sum[c], warp_xor(sum[c], mask));
            if (lane == 0) out[static_cast<int64_t>(row) * channels + first + c] = sum[c];
        }
    }
}

}  // namespace mass::device

namespace mass::gpu {

void product(const Rows& matrix, const float* dense, int channels, bool few, float* out, int device, void* stream) {
    const DeviceGuard guard(device);
    const Stream on = static_cast<Stream>(stream);
    if (few) {
        const int64_t threads = static_cast<int64_t>(matrix.count) * channels;
        launch(device::multiply_few, static_cast<int>((threads + device::kThreads - 1) / device::kThreads), device::kThreads, on, matrix,
               dense, channels, out);
    } else {
        constexpr int rows = device::kThreads / kWarp;
        launch(device::multiply_many, (matrix.count + rows - 1) / rows, device::kThreads, on, matrix, dense, channels, out);
    }
}

}  // namespace mass::gpu
