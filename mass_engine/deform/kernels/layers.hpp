// Dense layers on a few rows at a time, in registers: lanes are a layer's outputs, rows are surfels.
//
// Included by files compiled per instruction set (see raster/kernels/simd.hpp).
#pragma once

#include "decoder_types.hpp"
#include "simd.hpp"

namespace mass::MASS_ISA {

// A tile of kRows x kColumns vectors fits the registers: 32 of 512 bits, else 16 of a half or a quarter of that.
#if MASS_WIDTH == 16
inline constexpr int kRows = 12, kColumns = 2;
#elif MASS_WIDTH == 8
inline constexpr int kRows = 4, kColumns = 1;
#else
inline constexpr int kRows = 2, kColumns = 1;
#endif
static_assert(kBlockRows % kRows == 0, "a block is whole tiles");

// tile[r][v] += sum_k a[r, k] w[k, v]
template <int R, int V>
MASS_INLINE void multiply_add(const float* a, int a_stride, const float* w, int w_stride, int depth, F (&tile)[R][V]) {
    for (int k = 0; k < depth; ++k) {
        F row[V];
#pragma GCC unroll 4
        for (int v = 0; v < V; ++v) row[v] = load(w + k * w_stride + v * kLanes);
#pragma GCC unroll 16
        for (int r = 0; r < R; ++r) {
            const F x = splat(a[r * a_stride + k]);
#pragma GCC unroll 4
            for (int v = 0; v < V; ++v) tile[r][v] = fma(x, row[v], tile[r][v]);
        }
    }
}

// out[R, V] (after `finish` of each vector and its place) = start + a[R, depth] w[depth, V]
template <int R, int V, class Start, class Finish>
MASS_INLINE void tile_product(const float* a, int a_stride, const float* w, int w_stride, int depth, Start start, Finish finish) {
    F tile[R][V];
#pragma GCC unroll 16
    for (int r = 0; r < R; ++r) {
#pragma GCC unroll 4
        for (int v = 0; v < V; ++v) tile[r][v] = start(v);
    }
    multiply_add<R, V>(a, a_stride, w, w_stride, depth, tile);
#pragma GCC unroll 16
    for (int r = 0; r < R; ++r) {
#pragma GCC unroll 4
        for (int v = 0; v < V; ++v) finish(r, v, tile[r][v]);
    }
}

// finish(row, column, bias[column..] + a[row, :] w[:, column..]) for `rows` rows (whole tiles are computed) and `width`
// columns. `bias` may be null.
template <class Finish>
MASS_INLINE void product(const float* a, int a_stride, const float* w, int w_stride, int depth, const float* bias, int rows,
                         int width, Finish finish) {
    for (int column = 0; column < width;) {
        const float* wc = w + column;
        const auto start = [&](int v) { return bias ? load(bias + column + v * kLanes) : splat(0.0f); };
        const bool wide = width - column >= kColumns * kLanes;
        for (int row = 0; row < rows; row += kRows) {
            const auto done = [&](int r, int v, F x) { finish(row + r, column + v * kLanes, x); };
            const float* ar = a + row * a_stride;
            if (wide) {
                tile_product<kRows, kColumns>(ar, a_stride, wc, w_stride, depth, start, done);
            } else {
                tile_product<kRows, 1>(ar, a_stride, wc, w_stride, depth, start, done);
            }
        }
        column += wide ? kColumns * kLanes : kLanes;
    }
}

// sum[R rows of k, V] += sum_s a[s, k] g[s, :]: R and V are a tile's.
template <int R, int V>
MASS_INLINE void tile_outer(const float* a, int a_stride, const float* g, int g_stride, int count, float* sum, int sum_stride) {
    F tile[R][V];
#pragma GCC unroll 16
    for (int r = 0; r < R; ++r) {
#pragma GCC unroll 4
        for (int v = 0; v < V; ++v) tile[r][v] = load(sum + r * sum_stride + v * kLanes);
    }
    for (int s = 0; s < count; ++s) {
        F row[V];
#pragma GCC unroll 4
        for (int v = 0; v < V; ++v) row[v] = load(g + s * g_stride + v * kLanes);
#pragma GCC unroll 16
        for (int r = 0; r < R; ++r) {
            const F x = splat(a[s * a_stride + r]);
#pragma GCC unroll 4
            for (int v = 0; v < V; ++v) tile[r][v] = fma(x, row[v], tile[r][v]);
        }
    }
#pragma GCC unroll 16
    for (int r = 0; r < R; ++r) {
#pragma GCC unroll 4
        for (int v = 0; v < V; ++v) store(sum + r * sum_stride + v * kLanes, tile[r][v]);
    }
}

// sum[depth, width] += a[count, depth]^T g[count, width]
template <int R>
MASS_INLINE void outer(const float* a, int a_stride, int depth, const float* g, int g_stride, int width, int count, float* sum) {
    for (int column = 0; column < width;) {
        const bool wide = width - column >= kColumns * kLanes;
        for (int k = 0; k < depth; k += R) {
            float* out = sum + k * width + column;
            if (wide) {
                tile_outer<R, kColumns>(a + k, a_stride, g + column, g_stride, count, out, width);
            } else {
                tile_outer<R, 1>(a + k, a_stride, g + column, g_stride, count, out, width);
            }
        }
        column += wide ? kColumns * kLanes : kLanes;
    }
}

// sum[width] += sum_s g[s, :]
MASS_INLINE void sum_rows(const float* g, int width, int count, float* sum) {
    for (int column = 0; column < width; column += kLanes) {
        F total = load(sum + column);
        for (int s = 0; s < count; ++s) total = add(total, load(g + s * width + column));
        store(sum + column, total);
    }
}

}  // namespace mass::MASS_ISA
