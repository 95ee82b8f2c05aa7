// Sums over pixels -> gradients of the surfels, a thread each, and of the camera.
#define MASS_ISA device
#define MASS_WIDTH 0
#include "cuda_surfel.hpp"
#include "cuda_tile.hpp"
#include "differentiate_surfel.hpp"

namespace mass::device {

constexpr int kSurfelWarps = gpu::kSurfelThreads / kWarp;
constexpr int kPaddedCamera = 32;  // two sums of sixteen

// The camera's sums over the block, in a fixed order.
MASS_DEVICE void add_camera(const CameraSums& sums, float* partial) {
    MASS_SHARED float warps[kSurfelWarps][kPaddedCamera];
    const int warp = thread_index() / kWarp, lane = thread_index() % kWarp;
    float x[kPaddedCamera] = {};
    for (int k = 0; k < 9; ++k) x[k] = sums.A[k];
    for (int k = 0; k < 3; ++k) x[9 + k] = sums.t[k];
    for (int k = 0; k < 4; ++k) x[12 + k] = sums.K2[k];
    for (int k = 0; k < 2; ++k) x[16 + k] = sums.k[k];
    for (int k = 0; k < 3; ++k) x[18 + k] = sums.center[k];
    const float low = warp_sum16(x, lane), high = warp_sum16(x + 16, lane);
    warps[warp][lane] = lane < 16 ? low : high;
    sync_block();
    if (thread_index() >= kCameraGradient) return;
    float sum = 0.0f;
    for (int w = 0; w < kSurfelWarps; ++w) sum += warps[w][thread_index()];
    partial[block_index() * kCameraGradient + thread_index()] = sum;
}

template <int kHarmonics>
MASS_KERNEL(gpu::kSurfelThreads)
differentiate_surfels(CameraData given, const float* pose, const float* K, SurfelData in, gpu::Frame frame, int capacity, PairSums pairs,
                      SurfelGradient out) {
    const int i = block_index() * gpu::kSurfelThreads + thread_index();
    const int64_t at = i;
    const bool exists = i < in.count;
    CameraSums camera_sums{};
    float d_mean[3] = {}, d_tangent[6] = {}, total[16] = {};
    bool found = false;
    if (exists) {
        const Slots slots = slots_of(frame, capacity, i);
        found = collect(pairs, slots.begin, slots.end, total);
    }
    const PixelSums p = pixel_sums(total);
    if (found) {
        const CameraData camera = placed(given, pose, K);
        const SurfelLanes s = load_surfel(in, i);
        differentiate(camera, s, make_geometry(camera, s), p, true, camera_sums, d_mean, d_tangent);
        if constexpr (kHarmonics > 0) {
            float h[3 * kHarmonics], d_h[3 * kHarmonics];
            for (int k = 0; k < 3 * kHarmonics; ++k) h[k] = in.harmonics[at * 3 * kHarmonics + k];
            differentiate_harmonics(camera, kHarmonics, h, s.mean, p.color, true, camera_sums, d_mean, d_h);
            for (int k = 0; k < 3 * kHarmonics; ++k) out.harmonics[at * 3 * kHarmonics + k] = d_h[k];
        }
    }
    if (exists) {
        for (int k = 0; k < 3; ++k) out.means[3 * at + k] = d_mean[k];
        for (int k = 0; k < 6; ++k) out.tangents[6 * at + k] = d_tangent[k];
        out.opacities[at] = p.opacity;
        if constexpr (kHarmonics == 0) {
            for (int k = 0; k < 3; ++k) out.colors[3 * at + k] = p.color[k];
        } else if (!found) {
            for (int k = 0; k < 3 * kHarmonics; ++k) out.harmonics[at * 3 * kHarmonics + k] = 0.0f;
        }
    }
    add_camera(camera_sums, frame.camera_partial);
}

constexpr int kCameraThreads = 22 * kWarp;  // a warp for each number of the gradient, rounded up

// The sums of all blocks -> gradients of the pose [4,4] and of K [3,3]. The camera's centre, from which harmonics are
// seen, is -A^T t.
MASS_KERNEL(kCameraThreads) differentiate_camera(const float* pose, const float* partial, int blocks, float* d_pose, float* d_K) {
    MASS_SHARED float g[kCameraGradient];
    const int warp = thread_index() / kWarp, lane = thread_index() % kWarp;
    double sum = 0.0;
    if (warp < kCameraGradient) {
        for (int block = lane; block < blocks; block += kWarp) sum += partial[block * kCameraGradient + warp];
    }
    for (int mask = kWarp / 2; mask > 0; mask /= 2) sum += warp_xor(sum, mask);
    if (lane == 0 && warp < kCameraGradient) g[warp] = static_cast<float>(sum);
    sync_block();
    const int k = thread_index();
    const float* d_center = g + 18;
    if (k < 16) {
        const int row = k / 4, column = k % 4;
        float x = 0.0f;
        if (row < 3 && column < 3) {
            x = g[3 * row + column] - pose[4 * row + 3] * d_center[column];
        } else if (row < 3) {
            x = g[9 + row];
            for (int c = 0; c < 3; ++c) x -= pose[4 * row + c] * d_center[c];
        }
        d_pose[k] = x;
    } else if (k < 25) {
        const int row = (k - 16) / 3, column = (k - 16) % 3;
        d_K[k - 16] = row == 2 ? 0.0f : column == 2 ? g[16 + row] : g[12 + 2 * row + column];
    }
}

}  // namespace mass::device

namespace mass::gpu {

void project_backward(const Call& call, const ImageGradient& gradient, const SurfelGradient& out, float* d_pose, float* d_K) {
    const Frame& f = call.frame;
    const Stream stream = static_cast<Stream>(call.stream);
    const bool extra = gradient.normal || gradient.median || gradient.distortion;
    const PairSums sums{f.pair_gradient, extra, f.touched};
    const int blocks = surfel_blocks(call.shape.surfels);
    for_harmonics(call.surfels, [&](auto harmonics) {
        launch(device::differentiate_surfels<decltype(harmonics)::value>, blocks, kSurfelThreads, stream, call.camera, call.pose, call.K,
               call.surfels, f, call.shape.capacity, sums, out);
    });
    launch(device::differentiate_camera, 1, device::kCameraThreads, stream, call.pose, static_cast<const float*>(f.camera_partial), blocks,
           d_pose, d_K);
}

}  // namespace mass::gpu
