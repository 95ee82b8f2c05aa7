// The layers after the hash grid, forward and backward: a thread per surfel, weights in shared memory. The backward pass
// computes the activations again. Sums over surfels are made by blocks, each over surfels of its own, then over the blocks
// in their order.
#define MASS_ISA device
#define MASS_WIDTH 0
#include "device.hpp"

#include "decoder_outputs.hpp"
#include "passes.hpp"

#if defined(__CUDACC__)
#define MASS_UNROLL _Pragma("unroll")
#else
#define MASS_UNROLL
#endif

namespace mass::device {

template <int H>
struct Weights {
    float second[H][H], second_bias[H], head[H][kOutputs], head_bias[kOutputs];
};

template <int H>
MASS_DEVICE void load_weights(const DecoderData& d, int threads, Weights<H>& w) {
    for (int k = thread_index(); k < H * H; k += threads) w.second[k / H][k % H] = d.second[k];
    for (int k = thread_index(); k < H; k += threads) w.second_bias[k] = d.second_bias[k];
    for (int k = thread_index(); k < H * kOutputs; k += threads) w.head[k / kOutputs][k % kOutputs] = d.head[k];
    for (int k = thread_index(); k < kOutputs; k += threads) w.head_bias[k] = d.head_bias[k];
    sync_block();
}

MASS_DEVICE F first_layer(const DecoderData& d, int64_t n, int b, int i) {
    return relu(add(d.share[n * d.hidden + i], d.pose[b * d.hidden + i]));
}

template <int H>
MASS_DEVICE void second_layer(const DecoderData& d, const Weights<H>& w, int64_t n, int b, F (&out)[H]) {
    MASS_UNROLL
    for (int j = 0; j < H; ++j) out[j] = w.second_bias[j];
    for (int i = 0; i < H; ++i) {
        const F h = first_layer(d, n, b, i);
        MASS_UNROLL
        for (int j = 0; j < H; ++j) out[j] = fma(h, w.second[i][j], out[j]);
    }
    MASS_UNROLL
    for (int j = 0; j < H; ++j) out[j] = relu(out[j]);
}

inline constexpr int kDecodeThreads = 128;

template <int H>
MASS_KERNEL(kDecodeThreads) decode_rows(DecoderData d, ResidualRows out) {
    MASS_SHARED Weights<H> w;
    load_weights<H>(d, kDecodeThreads, w);
    const int64_t n = static_cast<int64_t>(block_index()) * kDecodeThreads + thread_index();
    if (n >= d.count) return;
    for (int b = 0; b < d.batch; ++b) {
        F refined[H], x[kOutputs];
        second_layer<H>(d, w, n, b, refined);
        MASS_UNROLL
        for (int k = 0; k < kOutputs; ++k) {
            x[k] = w.head_bias[k];
            MASS_UNROLL
            for (int j = 0; j < H; ++j) x[k] = fma(refined[j], w.head[j][k], x[k]);
        }
        const Outputs o = residuals_of(d.offset_unit, d.rotation_unit, [&](int k) { return x[k]; });
        const int64_t at = static_cast<int64_t>(b) * d.count + n;
        for (int k = 0; k < 3; ++k) out.offset[3 * at + k] = o.offset[k], out.rotation[3 * at + k] = o.rotation[k];
        for (int k = 0; k < 2; ++k) out.log_scale[2 * at + k] = o.log_scale[k];
        out.mask_logit[at] = o.mask_logit;
    }
}

// Surfels whose activations a block holds at a time.
template <int H>
inline constexpr int kRowsHeld = H <= 32 ? gpu::kMostRowsHeld : 32;

// sum[e] (+)= the sum over rows of a[row][e / columns] * c[row][e % columns], an entry a thread.
template <int rows, int A, int C>
MASS_DEVICE void sum_products(const float (&a)[rows][A], const float (&c)[rows][C], bool begin, float* sum) {
    for (int e = thread_index(); e < A * C; e += rows) {
        F total = begin ? 0.0f : sum[e];
        for (int r = 0; r < rows; ++r) total = fma(a[r][e / C], c[r][e % C], total);
        sum[e] = total;
    }
}

template <int rows, int C>
MASS_DEVICE void sum_columns(const float (&c)[rows][C], int columns, bool begin, float* sum) {
    for (int e = thread_index(); e < columns; e += rows) {
        F total = begin ? 0.0f : sum[e];
        for (int r = 0; r < rows; ++r) total = add(total, c[r][e]);
        sum[e] = total;
    }
}

template <int H>
MASS_KERNEL(kRowsHeld<H>) decode_rows_backward(DecoderData d, ResidualRowGradients g, float* d_share, float* partial, int size) {
    constexpr int kRows = kRowsHeld<H>;
    MASS_SHARED Weights<H> w;
    MASS_SHARED float active[kRows][H], slopes[kRows][H], d_out[kRows][kOutputs];
    load_weights<H>(d, kRows, w);
    const int t = thread_index();
    const gpu::DecoderSumPlaces at(H);
    float* sums = partial + static_cast<int64_t>(block_index()) * size;
    bool begin = true;
    for (int64_t first = static_cast<int64_t>(block_index()) * kRows; first < d.count; first += static_cast<int64_t>(block_count()) * kRows) {
        const int64_t n = first + t;
        const bool here = n < d.count;
        for (int b = 0; b < d.batch; ++b) {
            const bool start = begin && b == 0;
            F refined[H], x[kOutputs];
            if (here) {
                const int64_t row = static_cast<int64_t>(b) * d.count + n;
                for (int k = 0; k < 3; ++k) x[k] = g.offset[3 * row + k], x[5 + k] = g.rotation[3 * row + k];
                for (int k = 0; k < 2; ++k) x[3 + k] = g.log_scale[2 * row + k];
                x[8] = g.mask_logit[row];
                differentiate_outputs(d.offset_unit, d.rotation_unit, g.log_scale_value + 2 * row, x);
                second_layer<H>(d, w, n, b, refined);
            } else {
                for (int k = 0; k < kOutputs; ++k) x[k] = 0.0f;
                MASS_UNROLL
                for (int j = 0; j < H; ++j) refined[j] = 0.0f;
            }
            for (int k = 0; k < kOutputs; ++k) d_out[t][k] = x[k];
            MASS_UNROLL
            for (int j = 0; j < H; ++j) active[t][j] = refined[j];
            sync_block();
            sum_products<kRows, H, kOutputs>(active, d_out, start, sums + at.head);
            sum_columns<kRows, kOutputs>(d_out, kOutputs, start, sums + at.head_bias);
            sync_block();
            // `refined` becomes its own gradient before the rectifier.
            MASS_UNROLL
            for (int j = 0; j < H; ++j) {
                F sum = 0.0f;
                MASS_UNROLL
                for (int k = 0; k < kOutputs; ++k) sum = fma(x[k], w.head[j][k], sum);
                refined[j] = keep(lt(0.0f, refined[j]), sum);
                slopes[t][j] = refined[j];
            }
            for (int i = 0; i < H; ++i) active[t][i] = here ? first_layer(d, n, b, i) : 0.0f;
            sync_block();
            sum_products<kRows, H, H>(active, slopes, start, sums + at.second);
            sum_columns<kRows, H>(slopes, H, start, sums + at.second_bias);
            sync_block();
            for (int i = 0; i < H; ++i) {
                F sum = 0.0f;
                MASS_UNROLL
                for (int j = 0; j < H; ++j) sum = fma(w.second[i][j], refined[j], sum);
                sum = keep(lt(0.0f, active[t][i]), sum);
                slopes[t][i] = sum;
                if (here) d_share[n * H + i] = b == 0 ? sum : add(d_share[n * H + i], sum);
            }
            sync_block();
            sum_columns<kRows, H>(slopes, H, begin, sums + at.pose + b * H);
            sync_block();
        }
        begin = false;
    }
}

MASS_KERNEL(kDecodeThreads) sum_blocks(const float* partial, int blocks, int size, float* out) {
    const int e = block_index() * kDecodeThreads + thread_index();
    if (e >= size) return;
    double total = 0.0;
    for (int b = 0; b < blocks; ++b) total += static_cast<double>(partial[static_cast<int64_t>(b) * size + e]);
    out[e] = static_cast<float>(total);
}

}  // namespace mass::device

namespace mass::gpu {

namespace {

template <int H>
void start(const DecoderData& d, const ResidualRows& out, Stream on) {
    launch(device::decode_rows<H>, (d.count + device::kDecodeThreads - 1) / device::kDecodeThreads, device::kDecodeThreads, on, d, out);
}

template <int H>
void start_backward(const DecoderData& d, const ResidualRowGradients& g, float* d_share, float* partial, Stream on) {
    launch(device::decode_rows_backward<H>, decoder_blocks(d.count), device::kRowsHeld<H>, on, d, g, d_share, partial,
           decoder_sums(H, d.batch));
}

}  // namespace

void decode(const DecoderData& d, const ResidualRows& out, int device, void* stream) {
    const DeviceGuard guard(device);
    const Stream on = static_cast<Stream>(stream);
    switch (d.hidden) {
        case 16: return start<16>(d, out, on);
        case 32: return start<32>(d, out, on);
        case 48: return start<48>(d, out, on);
        case 64: return start<64>(d, out, on);
        default: throw DeviceError("no decoder of this width");
    }
}

void decode_backward(const DecoderData& d, const ResidualRowGradients& g, float* d_share, float* partial, float* sums, int device,
                     void* stream) {
    const DeviceGuard guard(device);
    const Stream on = static_cast<Stream>(stream);
    switch (d.hidden) {
        case 16: start_backward<16>(d, g, d_share, partial, on); break;
        case 32: start_backward<32>(d, g, d_share, partial, on); break;
        case 48: start_backward<48>(d, g, d_share, partial, on); break;
        case 64: start_backward<64>(d, g, d_share, partial, on); break;
        default: throw DeviceError("no decoder of this width");
    }
    const int size = decoder_sums(d.hidden, d.batch);
    launch(device::sum_blocks, (size + device::kDecodeThreads - 1) / device::kDecodeThreads, device::kDecodeThreads, on, partial,
           decoder_blocks(d.count), size, sums);
}

}  // namespace mass::gpu
