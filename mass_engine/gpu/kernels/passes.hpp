// What a fit does beside rasterising, on the GPU. No CUDA types, so that the bindings need no CUDA compiler. Nothing waits
// for the GPU; every sum has a fixed order. All throw DeviceError.
#pragma once

#include <cstdint>

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

// What residuals do to surfels, [rows,...] each; the gradient of the means passes unchanged.
void deform(const ResidualData& d, float* means, float* tangents, float* normals, int rows, int device, void* stream);
void deform_backward(const ResidualData& d, const ResidualGradient& g, int rows, int device, void* stream);

}  // namespace mass::gpu
