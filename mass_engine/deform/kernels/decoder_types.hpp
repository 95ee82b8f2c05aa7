// Plain data of the fused decoder. No functions: see raster/kernels/types.hpp.
#pragma once

namespace mass {

inline constexpr int kOutputs = 9;         // offset 3, log-scale 2, rotation 3, mask logit 1
inline constexpr int kPaddedOutputs = 16;  // one vector
inline constexpr int kMostHidden = 128;
// Rows whose activations are held at a time: they stay in the first-level cache.
inline constexpr int kBlockRows = 48;
// Rows per unit of work, whole blocks; fixed, so that sums do not depend on the thread count.
inline constexpr int kDecoderChunk = 20 * kBlockRows;

// x[b, n] = head(relu(second(relu(share[n] + pose[b])))); H = hidden. Residuals are of x: offset_unit x[0:3],
// log 2 tanh x[3:5], rotation_unit x[5:8], x[8].
struct DecoderData {
    const float* share;  // [N,H]
    const float* pose;   // [B,H]
    const float* second;  // [H,H]
    const float* second_bias;
    const float* head;  // [H,16], padded with zeros
    const float* head_bias;  // [16]
    const float* second_transposed;  // [H,H], backward only
    const float* head_transposed;    // [9,H], backward only
    float offset_unit, rotation_unit;
    int count, batch, hidden;        // N, B, H (a multiple of 16)
};

// [B,N,3], [B,N,2], [B,N,3], [B,N]
struct ResidualRows {
    float *offset, *log_scale, *rotation, *mask_logit;
};

// Their gradients, and the log-scales themselves, which know their own slope.
struct ResidualRowGradients {
    const float *offset, *log_scale, *rotation, *mask_logit, *log_scale_value;
};

// Offsets of one chunk's sums of gradients in floats.
struct DecoderSums {
    static constexpr int size(int hidden, int batch) {
        return hidden * hidden + hidden + kOutputs * hidden + kPaddedOutputs + batch * hidden;
    }
    float* second;            // [H,H]
    float* second_bias;       // [H]
    float* head_transposed;   // [9,H]
    float* head_bias;         // [16]
    float* pose;              // [B,H]
};

}  // namespace mass
