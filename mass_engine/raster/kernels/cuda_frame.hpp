// One frame on the GPU: what the host says, the memory it takes, and the passes in order. No CUDA types, so that the
// bindings need no CUDA compiler.
//
// Nothing here waits for the GPU: sizes follow from the shape alone, and what happened is left in `counters`. The
// surfels are sorted by depth first, a number of them that never changes, then listed tile by tile in that order and
// sorted by tile alone: few digits over the pairs, all digits only over the surfels.
#pragma once

#include <cstddef>
#include <cstdint>
#include <string>

#include "types.hpp"

namespace mass::gpu {

// What a frame's memory depends on.
struct Shape {
    int surfels, width, height;
    int capacity;  // pairs of surfel and tile there is room for
    bool extra, differentiable;
    std::size_t scratch_bytes;  // what sorting takes: scratch_bytes(most_items(shape))
};

inline int most_items(const Shape& s) { return s.surfels > s.capacity ? s.surfels : s.capacity; }

inline int tiles_of(const Shape& s) {
    return ((s.width + kTile - 1) / kTile) * ((s.height + kTile - 1) / kTile);
}

// counters[kStatus] is a sum of these.
enum Status : int {
    kOverflow = 1,   // more pairs than room: the picture lacks some
    kBadCamera = 2,  // NaN or infinity in the pose or in K: nothing is drawn
};
inline constexpr int kDropped = 0, kPairs = 1, kStatus = 2, kCounters = 3;  // pairs: at most 2^31 - 1

inline constexpr int kSurfelThreads = 128;  // of a block in passes over surfels

inline int surfel_blocks(int surfels) { return (surfels + kSurfelThreads - 1) / kSurfelThreads; }

// Views into one piece of device memory.
struct Frame {
    Splat* splats;
    Normal* normals;
    Box* boxes;
    uint32_t *depth, *depth_sorted, *index, *order;  // [N]; order: surfels, nearest first
    uint64_t *tiles, *tiles_before;                  // [N+1] by depth: how many tiles, and the sum of those before
    uint32_t* slot_begin;                            // [N] by surfel
    uint32_t *pair_tile, *pair_tile_sorted, *pair_surfel, *pair_surfel_sorted;  // [capacity]
    uint32_t* tile_begin;                                                       // [tiles+1]
    float* slot_weights;                                                        // [capacity]
    float *transmittance, *stop, *median_rank, *moments;
    PairGradient* pair_gradient;
    uint8_t* touched;
    float* camera_partial;  // [blocks of surfels, kCameraGradient]
    void* scratch;
};

// `camera` without its pose and K, which the kernels read from the device: pose [4,4], K [3,3], row major.
struct Call {
    CameraData camera;
    const float *pose, *K;
    SurfelData surfels;
    Shape shape;
    Frame frame;
    void* stream;
};

// Bytes of device memory a frame takes.
std::size_t frame_bytes(const Shape& shape);
// `base` is aligned to 256 bytes.
Frame lay_out(const Shape& shape, void* base);

// All throw DeviceError. `weights` [N] or null; counters [kCounters].
void forward(const Call& call, const ImageData& images, float* weights, int* counters, int device);
// d_pose [4,4], d_K [3,3]. `images` needs alpha and depth only.
void backward(const Call& call, const ImageData& images, const ImageGradient& gradient, const SurfelGradient& out, float* d_pose,
              float* d_K, int device);

// Why no kernel can run here; empty when one can.
std::string problem();

// The passes.
void project(const Call& call, int* counters);
void list_pairs(const Call& call, int* counters);
void blend(const Call& call, const ImageData& images, float* weights);
void blend_backward(const Call& call, const ImageData& images, const ImageGradient& gradient);
void project_backward(const Call& call, const ImageGradient& gradient, const SurfelGradient& out, float* d_pose, float* d_K);

// Bytes of scratch memory the next two take for `count` items; asks the driver.
std::size_t scratch_bytes(int count);
// Stable; the `bits` low bits of the keys count.
void sort_by_key(const Call& call, const uint32_t* keys, uint32_t* keys_out, const uint32_t* values, uint32_t* values_out, int count,
                 int bits);
// out[i] = the sum of in[0 .. i-1]
void sum_before(const Call& call, const uint64_t* in, uint64_t* out, int count);

}  // namespace mass::gpu
