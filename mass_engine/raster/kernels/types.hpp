// Plain data shared by the baseline code and the instruction-set specific code. No functions: the latter is
// compiled with other flags, and a shared inline function could be kept in a version the machine cannot run.
#pragma once

#include <cstdint>

#include "constants.hpp"

namespace mass {

// Which pixels a surfel may touch: where its opacity reaches the alpha cut, or what other renderers allow it.
enum class Bounds : int { kExact = 0, kInria = 1, kGsplat = 2 };

// What can be left out to measure what it is worth; the image stays the same bit for bit.
enum Without : unsigned {
    kWithoutTightBounds = 1,  // bounds of opacity 1 whatever the opacity
    kWithoutBlocks = 2,       // every block of a tile that the box meets
    kWithoutShortPath = 4,    // the full sum for surfels of which only the low-pass part can show
    kWithoutEarlyStop = 8,    // blocks go on after their last pixel has ended
    kWithoutEmptyTiles = 16,  // empty tiles are blended like any other
    kWithoutReuse = 32,       // buffers are allocated anew for each frame
    kWithoutFastSort = 64,    // a comparison sort of each tile
};

struct CameraData {
    float A[9];   // world_to_camera rotation, row major
    float t[3];   // world_to_camera translation
    float K2[4];  // upper left 2 x 2 of K
    float k[2];   // principal point, pixels
    float center[3];  // the camera's place in the world
    float near_z, inverse_near;
    int width, height;
    int tiles_x, tiles_y;
    bool cull_backfaces;
    Bounds bounds;
    bool center_depth;       // every pixel of a surfel has its centre's depth
    float distortion_scale;  // b in m = a - b / z
    unsigned without;        // Without
};

// means [N,3], tangents [N,2,3], opacities [N], and either colors [N,3] or harmonics [N,K,3].
struct SurfelData {
    const float *means, *tangents, *opacities, *colors, *harmonics;
    int count, coefficients;  // N, K (1, 4, 9 or 16)
};

// Inclusive pixel bounds inside the image; x1 < x0 when the surfel is not seen.
struct Box {
    int16_t x0, x1, y0, y1;
};

// One projected surfel: what a pixel needs to know, one cache line.
// With d = pixel - (mx, my): pz = 1 + g.d, (u, v) = (a.d, b.d) / pz, depth = zc / pz.
struct alignas(64) Splat {
    float mx, my;
    float a1, a2, b1, b2, g1, g2;
    float zc, opacity;
    float r, g, b;
    float low_pass_only;  // 1: rho2 < rho3 wherever the surfel reaches (sub-pixel or edge-on), a, b and g do not matter
    Box box;
};

struct Normal {
    float x, y, z, unused;
};

struct ProjectedData {
    Splat* splats;
    Normal* normals;  // null when not wanted
    Box* boxes;
    uint32_t* keys;  // bits of the centre depth: positive, so they sort as integers
};

// The (surfel, tile) pairs, grouped by tile, nearest first.
struct PairData {
    const uint32_t* tile_begin;  // [tiles + 1]
    const uint32_t* surfel;
    // First of a surfel's slots, [count + 1]: pair sums are kept surfel by surfel, then tile by tile in row order.
    // Null when no sums are wanted.
    const uint32_t* slot_begin;
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
    float g1, g2, zc, mx;
    float my, nx, ny, nz;
};

struct SurfelGradient {
    float *means, *tangents, *opacities, *colors, *harmonics;
};

// dA (9), dt (3), dK2 (4), dk (2), and of the camera's centre through view directions (3)
inline constexpr int kCameraGradient = 21;

struct PairSums {
    PairGradient* gradient;
    bool extra;        // a gradient of an extra output came in
    uint8_t* touched;  // the slot holds a value
};

// The functions each instruction set provides.
struct KernelTable {
    const char* name;
    // Surfels [begin, end) -> projected. Returns the number dropped because of bad numbers.
    int (*project)(const CameraData&, const SurfelData&, const ProjectedData&, int begin, int end);
    // Both return the number of (surfel, block) evaluations.
    int64_t (*blend)(const CameraData&, const ProjectedData&, const PairData&, const ImageData&, const PixelState&,
                     float* slot_weights, int tile);
    int64_t (*blend_backward)(const CameraData&, const ProjectedData&, const PairData&, const ImageData&,
                              const PixelState&, const ImageGradient&, const PairSums&, int tile);
    void (*project_backward)(const CameraData&, const SurfelData&, const uint32_t* slot_begin, const PairSums&,
                             const SurfelGradient&, float* camera_gradient, int begin, int end);
};

}  // namespace mass
