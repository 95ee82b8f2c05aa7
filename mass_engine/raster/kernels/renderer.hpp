// The passes in order, the buffers they use, and who owns them.
#pragma once

#include <memory>
#include <mutex>
#include <string>
#include <vector>

#include "binning.hpp"
#include "buffer.hpp"
#include "thread_pool.hpp"
#include "types.hpp"

namespace mass {

// Where the time of a frame went, in seconds, and how much there was to do.
struct FrameProfile {
    double project = 0, list = 0, blend = 0, gather_weights = 0, blend_backward = 0, project_backward = 0;
    double sort = 0;  // part of blend, summed over threads
    int64_t blocks = 0, blocks_backward = 0;
};

// Everything one forward pass leaves for its backward pass.
struct FrameBuffers {
    Buffer<Splat> splats;
    Buffer<Normal> normals;
    Buffer<Box> boxes;
    Buffer<uint32_t> keys;
    Binning binning;
    Buffer<float> slot_weights;
    Buffer<float> transmittance, stop, median_rank, moments;
    Buffer<PairGradient> pair_gradient;
    Buffer<uint8_t> touched;
    Buffer<float> camera_partial;

    CameraData camera{};
    int count = 0;
    bool extra = false, differentiable = false;
    int dropped = 0;
    FrameProfile profile;

    ProjectedData projected() const;
    PixelState state() const;
    std::size_t bytes() const;
};

class Renderer {
public:
    // `instruction_set`: "auto", "avx512", "avx2", "portable" or "scalar". Throws std::invalid_argument when this
    // machine or build lacks it.
    explicit Renderer(const std::string& instruction_set);

    const char* instruction_set() const { return table_->name; }
    static std::vector<std::string> available();

    // Extras are computed when images.normal is set; weights [count] when not null.
    std::unique_ptr<FrameBuffers> forward(const CameraData& camera, const SurfelData& surfels, const ImageData& images,
                                          float* weights, bool differentiable, int threads);

    // camera_gradient [kCameraGradient]. May be called again on the same frame.
    void backward(FrameBuffers& frame, const SurfelData& surfels, const ImageData& images, const ImageGradient& gradient,
                  const SurfelGradient& out, float* camera_gradient, int threads);

    // Takes buffers back for a later frame.
    void recycle(std::unique_ptr<FrameBuffers> frame);

private:
    std::unique_ptr<FrameBuffers> acquire();

    const KernelTable* table_;
    ThreadPool pool_;
    std::mutex mutex_;
    std::vector<std::unique_ptr<FrameBuffers>> free_;
};

}  // namespace mass
