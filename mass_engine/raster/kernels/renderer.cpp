#include "renderer.hpp"

#include <atomic>
#include <chrono>
#include <cstring>
#include <stdexcept>

#include "cpu_features.hpp"
#include "instruction_sets.hpp"

namespace mass {

namespace {

constexpr std::size_t kKeptFrames = 4;

std::size_t size(int n) { return static_cast<std::size_t>(n); }

std::vector<const KernelTable*> tables() {
    std::vector<const KernelTable*> found;
#if defined(MASS_BUILD_X86)
    if (has_avx512()) found.push_back(&avx512::table);
    if (has_avx2()) found.push_back(&avx2::table);
#endif
    found.push_back(&portable::table);
    found.push_back(&scalar::table);
    return found;
}

class Stopwatch {
public:
    // Seconds since it was made or last asked.
    double lap() {
        const auto now = std::chrono::steady_clock::now();
        const double seconds = std::chrono::duration<double>(now - last_).count();
        last_ = now;
        return seconds;
    }

private:
    std::chrono::steady_clock::time_point last_ = std::chrono::steady_clock::now();
};

int chunks(int count) { return (count + kChunk - 1) / kChunk; }

}  // namespace

ProjectedData FrameBuffers::projected() const {
    return {splats.data(), extra ? normals.data() : nullptr, boxes.data(), keys.data()};
}

PixelState FrameBuffers::state() const {
    if (!differentiable) return {nullptr, nullptr, nullptr, nullptr};
    return {transmittance.data(), stop.data(), extra ? median_rank.data() : nullptr, extra ? moments.data() : nullptr};
}

std::size_t FrameBuffers::bytes() const {
    return splats.bytes() + normals.bytes() + boxes.bytes() + keys.bytes() + binning.bytes() + slot_weights.bytes() +
           transmittance.bytes() + stop.bytes() + median_rank.bytes() + moments.bytes() + pair_gradient.bytes() +
           touched.bytes() + camera_partial.bytes();
}

Renderer::Renderer(const std::string& instruction_set) : table_(choose_table(tables(), instruction_set)) {}

std::vector<std::string> Renderer::available() {
    std::vector<std::string> names;
    for (const KernelTable* table : tables()) names.emplace_back(table->name);
    return names;
}

std::unique_ptr<FrameBuffers> Renderer::acquire() {
    std::lock_guard<std::mutex> lock(mutex_);
    if (free_.empty()) return std::make_unique<FrameBuffers>();
    auto frame = std::move(free_.back());
    free_.pop_back();
    return frame;
}

void Renderer::recycle(std::unique_ptr<FrameBuffers> frame) {
    std::lock_guard<std::mutex> lock(mutex_);
    if (free_.size() < kKeptFrames && !(frame->camera.without & kWithoutReuse)) free_.push_back(std::move(frame));
}

std::unique_ptr<FrameBuffers> Renderer::forward(const CameraData& camera, const SurfelData& surfels, const ImageData& images,
                                                float* weights, bool differentiable, int threads) {
    auto frame = camera.without & kWithoutReuse ? std::make_unique<FrameBuffers>() : acquire();
    const int count = surfels.count;
    frame->camera = camera;
    frame->count = count;
    frame->extra = images.normal != nullptr;
    frame->differentiable = differentiable;
    frame->splats.reserve(size(count));
    frame->boxes.reserve(size(count));
    frame->keys.reserve(size(count));
    if (frame->extra) frame->normals.reserve(size(count));
    const std::size_t pixels = size(camera.width) * size(camera.height);
    if (differentiable) {
        frame->transmittance.reserve(pixels);
        frame->stop.reserve(pixels);
        if (frame->extra) {
            frame->median_rank.reserve(pixels);
            frame->moments.reserve(3 * pixels);
        }
    }

    const ProjectedData projected = frame->projected();
    FrameProfile& profile = frame->profile = {};
    Stopwatch watch;
    std::atomic<int> dropped{0};
    pool_.loop(chunks(count), threads, [&](int chunk) {
        const int begin = chunk * kChunk, end = count - begin < kChunk ? count : begin + kChunk;
        dropped += table_->project(camera, surfels, projected, begin, end);
    });
    frame->dropped = dropped;
    profile.project = watch.lap();

    Binning& binning = frame->binning;
    binning.assign(camera, projected.boxes, projected.keys, count, differentiable || weights != nullptr, pool_, threads);
    const PairData pairs = binning.pairs();
    profile.list = watch.lap();

    float* slot_weights = nullptr;
    if (weights) {
        slot_weights = frame->slot_weights.reserve(binning.pair_count());
        if (binning.pair_count() > 0) std::memset(slot_weights, 0, binning.pair_count() * sizeof(float));
    }
    const PixelState state = frame->state();
    std::atomic<int64_t> blocks{0}, sort_nanoseconds{0};
    pool_.loop(camera.tiles_x * camera.tiles_y, threads, [&](int tile) {
        Stopwatch sorting;
        binning.sort(tile, (camera.without & kWithoutFastSort) != 0);
        sort_nanoseconds += static_cast<int64_t>(1e9 * sorting.lap());
        blocks += table_->blend(camera, projected, pairs, images, state, slot_weights, tile);
    });
    profile.sort = 1e-9 * static_cast<double>(sort_nanoseconds);
    profile.blocks = blocks;
    profile.blend = watch.lap();

    if (weights) {
        pool_.loop(chunks(count), threads, [&](int chunk) {
            const int begin = chunk * kChunk, end = count - begin < kChunk ? count : begin + kChunk;
            for (int i = begin; i < end; ++i) {
                float sum = 0.0f;
                for (uint32_t slot = binning.slot_begin()[i]; slot < binning.slot_begin()[i + 1]; ++slot) sum += slot_weights[slot];
                weights[i] = sum;
            }
        });
        profile.gather_weights = watch.lap();
    }
    return frame;
}

void Renderer::backward(FrameBuffers& frame, const SurfelData& surfels, const ImageData& images, const ImageGradient& gradient,
                        const SurfelGradient& out, float* camera_gradient, int threads) {
    const CameraData& camera = frame.camera;
    const ProjectedData projected = frame.projected();
    const PairData pairs = frame.binning.pairs();
    const PixelState state = frame.state();
    const std::size_t pair_count = frame.binning.pair_count();
    const bool extra = gradient.normal || gradient.median || gradient.distortion;

    PairSums sums{};
    sums.gradient = frame.pair_gradient.reserve(pair_count);
    sums.extra = extra;
    sums.touched = frame.touched.reserve(pair_count + 1);
    Stopwatch watch;
    std::memset(sums.touched, 0, pair_count);
    std::atomic<int64_t> blocks{0};
    pool_.loop(camera.tiles_x * camera.tiles_y, threads, [&](int tile) {
        blocks += table_->blend_backward(camera, projected, pairs, images, state, gradient, sums, tile);
    });
    frame.profile.blocks_backward = blocks;
    frame.profile.blend_backward = watch.lap();

    const int n = chunks(frame.count);
    float* partial = frame.camera_partial.reserve(size(n) * kCameraGradient + 1);
    pool_.loop(n, threads, [&](int chunk) {
        const int begin = chunk * kChunk, end = frame.count - begin < kChunk ? frame.count : begin + kChunk;
        table_->project_backward(camera, surfels, frame.binning.slot_begin(), sums, out,
                                 partial + size(chunk) * kCameraGradient, begin, end);
    });
    for (int k = 0; k < kCameraGradient; ++k) {
        double sum = 0.0;
        for (int chunk = 0; chunk < n; ++chunk) sum += partial[size(chunk) * kCameraGradient + size(k)];
        camera_gradient[k] = static_cast<float>(sum);
    }
    frame.profile.project_backward = watch.lap();
}

}  // namespace mass
