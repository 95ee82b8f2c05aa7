// What a fit does beside rasterising, on the GPU. No CUDA types, so that the bindings need no CUDA compiler. Nothing waits
// for the GPU; every sum has a fixed order. All throw DeviceError.
#pragma once

#include <cstdint>

#include "decoder_types.hpp"
#include "residual_types.hpp"

namespace mass::gpu {

// A sparse matrix by rows: those of row r are at begins[r] .. begins[r + 1] - 1.
struct Rows {
    const int32_t* begins;
    const int32_t* columns;
    const float* values;
    int count;
};

// out [rows,channels] = matrix * dense [columns,channels]. `few`: rows have about ten entries, a thread takes one; else a
// warp does.
void product(const Rows& matrix, const float* dense, int channels, bool few, float* out, int device, void* stream);

// Two pictures [height,width,3]; only pixels with `inside` [height,width] count.
struct Pictures {
    const float *seen, *wanted, *inside;
    int height, width;
};

inline constexpr int kSsimTile = 16;
inline int ssim_blocks(int height, int width) {
    return ((height + kSsimTile - 1) / kSsimTile) * ((width + kSsimTile - 1) / kSsimTile);
}

// sums [blocks,2]: of (1 - SSIM) / 2 over a block's pixels that count, and of these. slopes [3,height,width] (or null): how
// the former changes with the window's means of seen, seen^2 and seen * wanted.
void ssim(const Pictures& p, float* sums, float* slopes, int device, void* stream);
// d_seen [height,width,3] of scale * the sum over all blocks.
void ssim_backward(const Pictures& p, const float* slopes, const float* scale, float* d_seen, int device, void* stream);

// Where a block's sums of the decoder's gradients lie: second [H,H], its bias [H], head [H,9], its bias [9], pose [B,H].
struct DecoderSumPlaces {
    int second, second_bias, head, head_bias, pose;
#if defined(__CUDACC__)
    __device__
#endif
    explicit DecoderSumPlaces(int hidden)
        : second(0), second_bias(hidden * hidden), head(second_bias + hidden), head_bias(head + hidden * kOutputs),
          pose(head_bias + kOutputs) {}
};
constexpr int decoder_sums(int hidden, int batch) { return hidden * hidden + hidden + (hidden + 1) * kOutputs + batch * hidden; }
// Fixed by the number of surfels alone, so that sums are the same on every GPU; each has some.
inline constexpr int kMostRowsHeld = 64;
inline int decoder_blocks(int count) {
    const int chunks = (count + kMostRowsHeld - 1) / kMostRowsHeld;
    return chunks < 1 ? 1 : chunks < 512 ? chunks : 512;
}

// The layers after the hash grid; `d.head` is [H,9], its hidden width 16, 32, 48 or 64.
void decode(const DecoderData& d, const ResidualRows& out, int device, void* stream);
// partial [blocks,sums] is scratch.
void decode_backward(const DecoderData& d, const ResidualRowGradients& g, float* d_share, float* partial, float* sums, int device,
                     void* stream);

// What residuals do to surfels, [rows,...] each; the gradient of the means passes unchanged.
void deform(const ResidualData& d, float* means, float* tangents, float* normals, int rows, int device, void* stream);
void deform_backward(const ResidualData& d, const ResidualGradient& g, int rows, int device, void* stream);

}  // namespace mass::gpu
