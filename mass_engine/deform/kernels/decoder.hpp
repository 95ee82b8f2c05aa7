// The decoder of the deformation, forward and backward, without its activations ever leaving the cache: the backward
// pass computes them again.
#pragma once

#include "decoder_outputs.hpp"
#include "decoder_types.hpp"
#include "layers.hpp"
#include "vectors.hpp"

namespace mass::MASS_ISA {

// hidden[rows, H] = relu(share + pose); rows beyond `count` are zero, to the end of a block.
MASS_INLINE void first_layer(const float* share, const float* pose, int count, int hidden, float* out) {
    for (int column = 0; column < hidden; column += kLanes) {
        const F p = load(pose + column);
        for (int row = 0; row < count; ++row) store(out + row * hidden + column, relu(add(load(share + row * hidden + column), p)));
        for (int row = count; row < kBlockRows; ++row) store(out + row * hidden + column, splat(0.0f));
    }
}

MASS_INLINE void second_layer(const DecoderData& d, const float* hidden, int rows, float* out) {
    product(hidden, d.hidden, d.second, d.hidden, d.hidden, d.second_bias, rows, d.hidden,
            [&](int row, int column, F x) { store(out + row * d.hidden + column, relu(x)); });
}

// Outputs [48,16] of one block of `count` surfels from `first` on in pose b.
MASS_INLINE void decode_block(const DecoderData& d, int b, int first, int count, float* out) {
    alignas(64) float hidden[kBlockRows * kMostHidden], refined[kBlockRows * kMostHidden];
    first_layer(d.share + static_cast<long>(first) * d.hidden, d.pose + b * d.hidden, count, d.hidden, hidden);
    second_layer(d, hidden, count, refined);
    product(refined, d.hidden, d.head, kPaddedOutputs, d.hidden, d.head_bias, count, kPaddedOutputs,
            [&](int row, int column, F x) { store(out + row * kPaddedOutputs + column, x); });
}

// Residuals of sixteen surfels from the decoder's outputs [16 surfels,16].
MASS_INLINE Outputs residuals_of(const DecoderData& d, const float* block) {
    return residuals_of(d.offset_unit, d.rotation_unit, [&](int k) { return gather(block + k, kPaddedOutputs); });
}

// Surfels [begin, end) in every pose.
inline void decode(const DecoderData& d, const ResidualRows& out, int begin, int end) {
    alignas(64) float block[kBlockRows * kPaddedOutputs];
    for (int first = begin; first < end; first += kBlockRows) {
        const int rows = end - first < kBlockRows ? end - first : kBlockRows;
        for (int b = 0; b < d.batch; ++b) {
            decode_block(d, b, first, rows, block);
            for (int row = 0; row < rows; row += kLanes) {
                const int count = rows - row < kLanes ? rows - row : kLanes;
                const long at = static_cast<long>(b) * d.count + first + row;
                const Outputs o = residuals_of(d, block + row * kPaddedOutputs);
                interleave<3>(o.offset, count, out.offset + 3 * at);
                interleave<2>(o.log_scale, count, out.log_scale + 2 * at);
                interleave<3>(o.rotation, count, out.rotation + 3 * at);
                interleave<1>(&o.mask_logit, count, out.mask_logit + at);
            }
        }
    }
}

// Gradients of the decoder's outputs [48,9] of `rows` surfels from those of the residuals; zero beyond.
MASS_INLINE void output_gradients(const DecoderData& d, const ResidualRowGradients& g, long at, int rows, float* block) {
    for (int row = 0; row < kBlockRows; row += kLanes) {
        const int left = rows - row, count = left < 0 ? 0 : (left < kLanes ? left : kLanes);
        const long here = at + row;
        F out[kOutputs], log_scale[2];
        if (count == 0) {
            std::memset(block + row * kOutputs, 0, kLanes * kOutputs * sizeof(float));
            continue;
        }
        load_rows<3>(g.offset + 3 * here, count, out);
        load_rows<2>(g.log_scale + 2 * here, count, out + 3);
        load_rows<3>(g.rotation + 3 * here, count, out + 5);
        load_rows<1>(g.mask_logit + here, count, out + 8);
        load_rows<2>(g.log_scale_value + 2 * here, count, log_scale);
        differentiate_outputs(d.offset_unit, d.rotation_unit, log_scale, out);
        interleave<kOutputs>(out, kLanes, block + row * kOutputs);
    }
}

// Gradients: d_share [N,H] of surfels [begin, end), and this chunk's sums of the rest.
inline void decode_backward(const DecoderData& d, const ResidualRowGradients& given, float* d_share, const DecoderSums& sums, int begin,
                            int end) {
    constexpr int kOuterRows = MASS_WIDTH == 16 ? 8 : kRows;
    const int H = d.hidden;
    alignas(64) float hidden[kBlockRows * kMostHidden], refined[kBlockRows * kMostHidden];
    alignas(64) float gradient[kBlockRows * kMostHidden], d_hidden[kBlockRows * kMostHidden];
    alignas(64) float d_block[kBlockRows * kOutputs];
    for (int first = begin; first < end; first += kBlockRows) {
        const int count = end - first < kBlockRows ? end - first : kBlockRows;
        float* share_rows = d_share + static_cast<long>(first) * H;
        for (int b = 0; b < d.batch; ++b) {
            first_layer(d.share + static_cast<long>(first) * H, d.pose + b * H, count, H, hidden);
            second_layer(d, hidden, count, refined);
            output_gradients(d, given, static_cast<long>(b) * d.count + first, count, d_block);
            for (int k = 0; k < kOutputs; ++k) {
                for (int row = 0; row < count; ++row) sums.head_bias[k] += d_block[row * kOutputs + k];
            }
            outer<kOutputs>(d_block, kOutputs, kOutputs, refined, H, H, count, sums.head_transposed);
            product(d_block, kOutputs, d.head_transposed, H, kOutputs, nullptr, count, H, [&](int row, int column, F x) {
                const F active = load(refined + row * H + column);
                store(gradient + row * H + column, keep(lt(splat(0.0f), active), x));
            });
            sum_rows(gradient, H, count, sums.second_bias);
            outer<kOuterRows>(hidden, H, H, gradient, H, H, count, sums.second);
            product(gradient, H, d.second_transposed, H, H, nullptr, count, H, [&](int row, int column, F x) {
                const F active = load(hidden + row * H + column);
                store(d_hidden + row * H + column, keep(lt(splat(0.0f), active), x));
            });
            sum_rows(d_hidden, H, count, sums.pose + b * H);
            for (int k = 0; k < count * H; k += kLanes) {
                const F x = load(d_hidden + k);
                store(share_rows + k, b == 0 ? x : add(load(share_rows + k), x));
            }
        }
    }
}

}  // namespace mass::MASS_ISA
