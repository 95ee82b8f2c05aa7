// Plain data of the fused posing of surfels. No functions: see raster/kernels/types.hpp.
#pragma once

#include <cstdint>

#include "decoder_types.hpp"

namespace mass {

inline constexpr int kTable = 16;  // entries of a table that lanes look up: one vector

// M surfels. Planes hold one number of every surfel after another, `stride` apart, readable 16 past the last.
struct PosingData {
    const float* vertices;        // [V,3] posed, of the refined mesh
    const int32_t* corners;       // [3] planes: 3 times the index of each corner of the surfel's face
    const int32_t* places;        // [M] which of the face's small triangles
    const float* coefficients;    // [6][16] of (b - a, c - a), by place: mean - a, first tangent, second tangent
    const int32_t* bones;         // [M]
    const float* rotations;       // [9][16]: entry (i, j) of each bone's rotation
    const float* albedo;          // [3] planes
    const float* harmonics;       // [3 K] planes, coefficient k of channel c at 3 k + c
    const float* opacities;       // [M]
    const float* light;           // [9,3]
    float center[3];              // the camera's place
    int count, stride, harmonics_count;  // M, -, K: 0, 3, 8 or 15
    DecoderData decoder;          // one pose; its row n is surfel deformed_from + n
    int deformed_from;            // M: none is deformed
    const float* fixed;           // [8] planes: offset, factors of the tangents, rotation of those before; null: none
};

struct PosedData {
    float *means, *tangents, *normals, *opacities, *colors;  // [M,3], [M,2,3], [M,3], [M], [M,3]
};

}  // namespace mass
