// The memory of a frame, and its passes in order.
#include "device.hpp"

#include "cuda_frame.hpp"

namespace mass::gpu {

namespace {

std::size_t size(int n) { return static_cast<std::size_t>(n); }

// Hands out pieces of one block of memory, each aligned as cudaMalloc aligns.
class Pieces {
public:
    explicit Pieces(void* base) : base_(static_cast<char*>(base)) {}
    template <typename T>
    T* take(std::size_t count) {
        T* made = base_ ? reinterpret_cast<T*>(base_ + used_) : nullptr;
        used_ += (count * sizeof(T) + 255) / 256 * 256;
        return made;
    }
    std::size_t used() const { return used_; }

private:
    char* base_;
    std::size_t used_ = 0;
};

Frame take_all(const Shape& shape, Pieces& pieces) {
    const std::size_t n = size(shape.surfels), room = size(shape.capacity), pixels = size(shape.width) * size(shape.height);
    Frame f{};
    f.splats = pieces.take<Splat>(n);
    f.boxes = pieces.take<Box>(n);
    f.depth = pieces.take<uint32_t>(n);
    f.depth_sorted = pieces.take<uint32_t>(n);
    f.index = pieces.take<uint32_t>(n);
    f.order = pieces.take<uint32_t>(n);
    f.tiles = pieces.take<uint64_t>(n + 1);
    f.tiles_before = pieces.take<uint64_t>(n + 1);
    f.slot_begin = pieces.take<uint32_t>(n);
    f.pair_tile = pieces.take<uint32_t>(room);
    f.pair_tile_sorted = pieces.take<uint32_t>(room);
    f.pair_surfel = pieces.take<uint32_t>(room);
    f.pair_surfel_sorted = pieces.take<uint32_t>(room);
    f.tile_begin = pieces.take<uint32_t>(size(tiles_of(shape)) + 1);
    if (shape.extra) {
        f.normals = pieces.take<Normal>(n);
        f.slot_weights = pieces.take<float>(room);
    }
    if (shape.differentiable) {
        f.transmittance = pieces.take<float>(pixels);
        f.stop = pieces.take<float>(pixels);
        if (shape.extra) {
            f.median_rank = pieces.take<float>(pixels);
            f.moments = pieces.take<float>(3 * pixels);
        }
        f.pair_gradient = pieces.take<PairGradient>(room);
        f.touched = pieces.take<uint8_t>(room);
        f.camera_partial = pieces.take<float>(size(surfel_blocks(shape.surfels)) * kCameraGradient);
    }
    f.scratch = pieces.take<char>(shape.scratch_bytes);
    return f;
}

}  // namespace

std::size_t frame_bytes(const Shape& shape) {
    Pieces pieces(nullptr);
    take_all(shape, pieces);
    return pieces.used();
}

Frame lay_out(const Shape& shape, void* base) {
    Pieces pieces(base);
    return take_all(shape, pieces);
}

void forward(const Call& call, const ImageData& images, float* weights, int* counters, int device) {
    const DeviceGuard guard(device);
    fill_bytes(counters, 0, sizeof(int) * kCounters, static_cast<Stream>(call.stream));
    project(call, counters);
    list_pairs(call, counters);
    blend(call, images, weights);
}

void backward(const Call& call, const ImageData& images, const ImageGradient& gradient, const SurfelGradient& out, float* d_pose,
              float* d_K, int device) {
    const DeviceGuard guard(device);
    blend_backward(call, images, gradient);
    project_backward(call, gradient, out, d_pose, d_K);
}

std::string problem() { return device_problem(); }

}  // namespace mass::gpu
