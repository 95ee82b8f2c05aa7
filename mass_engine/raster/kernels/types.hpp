// Plain data shared by the baseline code and the instruction-set specific code. No functions: the latter is
// compiled with other flags, and a shared inline function could be kept in a version the machine cannot run.
#pragma once

#include <cstdint>

#include "constants.hpp"

namespace mass {

struct CameraData {
    float A[9];   // world_to_camera rotation, row major
    float t[3];   // world_to_camera translation
    float K2[4];  // upper left 2 x 2 of K
    float k[2];   // principal point, pixels
    float near_z;
    int width, height;
    int tiles_x, tiles_y;
    bool cull_backfaces;
    float distortion_scale;  // b in m = a - b / z
};

struct SurfelData {
    const float *means, *quats, *scales, *opacities, *colors;
    int count;
};

// One projected surfel: what a pixel needs to know, one cache line.
// With d = pixel - (mx, my): pz = 1 + g.d, (u, v) = (a.d, b.d) / pz, depth = zc / pz.
struct alignas(64) Splat {
    float mx, my;
    float a1, a2, b1, b2, g1, g2;
    float zc, opacity;
    float rho_cut;  // no pixel with a larger rho passes kAlphaCut (slightly generous)
    float pz_max;   // zc / near: a larger pz lies before the near plane; negative: no 3-D part at all
    float r, g, b;
    float unused;
};

struct Normal {
    float x, y, z, unused;
};

// Inclusive pixel bounds inside the image.
struct Box {
    int16_t x0, x1, y0, y1;
};

inline constexpr uint32_t kCulled = 0xffffffffu;

struct ProjectedData {
    Splat* splats;
    Normal* normals;  // null when not wanted
    Box* boxes;
    uint32_t* keys;  // bits of the centre depth (positive, so they sort as integers), or kCulled
};

// The (surfel, tile) pairs, grouped by tile, nearest first.
struct PairData {
    const uint32_t* tile_begin;  // [tiles + 1]
    const uint32_t* surfel;
    const uint16_t* blocks;  // which of the tile's 16 blocks the bounds touch
    const uint32_t* slot;    // where the pair's per-surfel sums go; null when none are wanted
};

struct ImageData {  // outputs; extras are null unless wanted
    float *rgb, *alpha, *depth;
    float *median, *normal, *distortion;
};

// Per pixel, kept for the backward pass. Ranks count the pairs of a tile's list, exact in float32 below 2^24.
struct PixelState {
    float* transmittance;
    float* stop;         // rank of the pair that ended the pixel; list length or more when none did
    float* median_rank;  // rank of the pair that gave the median depth, -1 when none did
    float* moments;      // [H,W,3] inverse depth of the first surfel, sum w m, sum w m^2
};

struct ImageGradient {  // null means zero
    const float *rgb, *alpha, *depth;
    const float *median, *normal, *distortion;
};

// Sums over a pair's pixels, in the order the kernel writes them.
struct alignas(64) PairGradient {
    float r, g, b, opacity;
    float a1, a2, b1, b2;
    float g1, g2, zc, low_x;
    float low_y, pu, pv, pz;
};

struct SurfelGradient {
    float *means, *quats, *scales, *opacities, *colors;
};

// dA (9), dt (3), dK2 (4), dk (2)
inline constexpr int kCameraGradient = 18;

struct PairSums {
    PairGradient* gradient;
    Normal* normal;    // gradient of the normal; null unless a normal gradient came in
    uint8_t* touched;  // the slot holds a value
};

// The functions each instruction set provides.
struct KernelTable {
    const char* name;
    // Surfels [begin, end) -> projected. Returns the number dropped because of bad numbers.
    int (*project)(const CameraData&, const SurfelData&, const ProjectedData&, int begin, int end);
    void (*blend)(const CameraData&, const ProjectedData&, const PairData&, const ImageData&, const PixelState&,
                  float* slot_weights, int tile);
    void (*blend_backward)(const CameraData&, const ProjectedData&, const PairData&, const ImageData&,
                           const PixelState&, const ImageGradient&, const PairSums&, int tile);
    void (*project_backward)(const CameraData&, const SurfelData&, const uint32_t* slot_begin,
                             const uint32_t* slot_end, const PairSums&, const SurfelGradient&,
                             float* camera_gradient, int begin, int end);
};

}  // namespace mass
