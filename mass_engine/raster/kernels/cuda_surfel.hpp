// What the passes over surfels share.
#pragma once

#include <type_traits>
#include "device.hpp"

#include "cuda_frame.hpp"
#include "geometry.hpp"

namespace mass::device {

// The camera with its pose and K.
MASS_DEVICE CameraData placed(CameraData c, const float* pose, const float* K) {
    for (int r = 0; r < 3; ++r) {
        for (int k = 0; k < 3; ++k) c.A[3 * r + k] = pose[4 * r + k];
        c.t[r] = pose[4 * r + 3];
    }
    c.K2[0] = K[0];
    c.K2[1] = K[1];
    c.k[0] = K[2];
    c.K2[2] = K[3];
    c.K2[3] = K[4];
    c.k[1] = K[5];
    for (int k = 0; k < 3; ++k) c.center[k] = -(c.A[k] * c.t[0] + c.A[3 + k] * c.t[1] + c.A[6 + k] * c.t[2]);
    return c;
}

MASS_DEVICE SurfelLanes load_surfel(const SurfelData& in, int i) {
    const int64_t at = i;
    SurfelLanes s;
    for (int k = 0; k < 3; ++k) s.mean[k] = in.means[3 * at + k];
    for (int k = 0; k < 6; ++k) s.tangent[k] = in.tangents[6 * at + k];
    s.opacity = in.opacities[at];
    for (int k = 0; k < 3; ++k) s.color[k] = in.colors ? in.colors[3 * at + k] : 0.0f;
    return s;
}

// How many tiles a box meets.
MASS_DEVICE int count_tiles(const Box& b) {
    return b.x1 < b.x0 ? 0 : (b.x1 / kTile - b.x0 / kTile + 1) * (b.y1 / kTile - b.y0 / kTile + 1);
}

// A surfel's slots, as far as there is room.
struct Slots {
    uint32_t begin, end;
};

MASS_DEVICE Slots slots_of(const gpu::Frame& frame, int capacity, int i) {
    const uint32_t room = static_cast<uint32_t>(capacity), begin = frame.slot_begin[i];
    const uint64_t end = static_cast<uint64_t>(begin) + static_cast<uint64_t>(count_tiles(frame.boxes[i]));
    return {begin, end < room ? static_cast<uint32_t>(end) : room};
}

}  // namespace mass::device

namespace mass::gpu {

// Calls run<K>() for the number of harmonics K: 0 for plain colours, 1, 4, 9 or 16.
template <typename Run>
void for_harmonics(const SurfelData& in, Run run) {
    switch (in.harmonics ? in.coefficients : 0) {
        case 0: return run(std::integral_constant<int, 0>());
        case 1: return run(std::integral_constant<int, 1>());
        case 4: return run(std::integral_constant<int, 4>());
        case 9: return run(std::integral_constant<int, 9>());
        default: return run(std::integral_constant<int, 16>());
    }
}

}  // namespace mass::gpu
