// Every number the rasteriser's result depends on. reference.py holds the same values; a test compares them.
#pragma once

namespace mass {

// Opacity of one surfel at one pixel never exceeds this, so that the transmittance stays invertible.
inline constexpr float kAlphaMax = 0.99f;
// A surfel weaker than one 8-bit step at a pixel is not blended there.
inline constexpr float kAlphaCut = 1.0f / 255.0f;
// A surfel that would take the transmittance below this is not blended, and ends its pixel.
inline constexpr float kTransmittanceStop = 1e-4f;
// rho2 = kLowPass * squared pixel distance: a screen-space Gaussian of sigma sqrt(1/2) px.
inline constexpr float kLowPass = 2.0f;
// Median depth is that of the last surfel met with more transmittance than this.
inline constexpr float kMedianTransmittance = 0.5f;
// Below this |cosine| between the normal and the viewing ray the disk is edge-on: only its low-pass part is drawn.
inline constexpr float kEdgeOnCosine = 1e-4f;
// A surfel whose tangents are parallel (squared sine) or too short (squared length of their product) is dropped.
inline constexpr float kLeastSine2 = 1e-12f;
inline constexpr float kLeastArea2 = 1e-37f;
// The bounds of other renderers (Bounds in types.hpp), in standard deviations; theirs is a low-pass of sqrt(1/2) px.
inline constexpr float kInriaReach = 3.0f;
inline constexpr float kGsplatReach = 3.33f;
// Layout, without influence on the result: a tile is 4 x 4 blocks, a block is 4 x 4 pixels and one vector.
inline constexpr int kLanes = 16;
inline constexpr int kBlock = 4;
inline constexpr int kTile = 16;
inline constexpr int kBlocksPerTile = 16;
// Bounds are widened by this many pixels, far above rounding error; the per-pixel cut decides.
inline constexpr float kBoundsMargin = 0.01f;
// Surfels per unit of work in per-surfel passes; fixed, so that sums do not depend on the thread count.
inline constexpr int kChunk = 2048;

}  // namespace mass
