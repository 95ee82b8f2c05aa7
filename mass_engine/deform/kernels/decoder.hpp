// The decoder of the deformation, forward and backward, without its activations ever leaving the cache: the backward
// pass computes them again.
#pragma once

#include "decoder_types.hpp"
#include "layers.hpp"

namespace mass::MASS_ISA {

MASS_INLINE F relu(F x) { return max(x, splat(0.0f)); }

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

// Surfels [begin, end) in every pose; out [B,N,9].
inline void decode(const DecoderData& d, float* out, int begin, int end) {
    alignas(64) float block[kBlockRows * kPaddedOutputs];
    for (int first = begin; first < end; first += kBlockRows) {
        const int count = end - first < kBlockRows ? end - first : kBlockRows;
        for (int b = 0; b < d.batch; ++b) {
            decode_block(d, b, first, count, block);
            float* rows = out + (static_cast<long>(b) * d.count + first) * kOutputs;
            for (int row = 0; row < count; ++row) {
                std::memcpy(rows + row * kOutputs, block + row * kPaddedOutputs, kOutputs * sizeof(float));
            }
        }
    }
}

// Gradients from d_out [B,N,9]: d_share [N,H] of surfels [begin, end), and this chunk's sums of the rest.
inline void decode_backward(const DecoderData& d, const float* d_out, float* d_share, const DecoderSums& sums, int begin,
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
            const std::size_t given = static_cast<std::size_t>(count) * kOutputs;
            std::memcpy(d_block, d_out + (static_cast<long>(b) * d.count + first) * kOutputs, given * sizeof(float));
            for (std::size_t k = given; k < kBlockRows * kOutputs; ++k) d_block[k] = 0.0f;

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
