// Sums over pixels -> gradients of the surfels and of the camera.
#pragma once

#include "differentiate_surfel.hpp"
#include "lanes.hpp"
#include "reduce.hpp"

namespace mass::MASS_ISA {

struct LaneGradient {
    alignas(64) float mean[3][kLanes], tangent[6][kLanes], opacity[kLanes], color[3][kLanes], harmonics[48][kLanes];
};

MASS_INLINE void differentiate_lane_harmonics(const CameraData& camera, const SurfelData& in, const int* ids, const F* mean,
                                              const F* d_color, M exists, CameraSums& sums, F* d_mean, LaneGradient& out) {
    const int K = in.coefficients;
    alignas(64) float lanes[48][kLanes];
    for (int l = 0; l < kLanes; ++l) {
        const float* from = in.harmonics + static_cast<int64_t>(ids[l]) * 3 * K;
        for (int k = 0; k < 3 * K; ++k) lanes[k][l] = from[k];
    }
    F h[48], d_h[48];
    for (int k = 0; k < 3 * K; ++k) h[k] = load(lanes[k]);
    differentiate_harmonics(camera, K, h, mean, d_color, exists, sums, d_mean, d_h);
    for (int k = 0; k < 3 * K; ++k) store(out.harmonics[k], d_h[k]);
}

MASS_INLINE void scatter(const LaneGradient& g, const int* ids, int count, const SurfelData& in, const SurfelGradient& out) {
    const int coefficients = 3 * in.coefficients;
    for (int l = 0; l < count; ++l) {
        const int64_t i = ids[l];
        for (int k = 0; k < 3; ++k) out.means[3 * i + k] = g.mean[k][l];
        for (int k = 0; k < 6; ++k) out.tangents[6 * i + k] = g.tangent[k][l];
        out.opacities[i] = g.opacity[l];
        if (out.colors) {
            for (int k = 0; k < 3; ++k) out.colors[3 * i + k] = g.color[k][l];
        } else {
            for (int k = 0; k < coefficients; ++k) out.harmonics[coefficients * i + k] = g.harmonics[k][l];
        }
    }
}

void project_backward(const CameraData& camera, const SurfelData& in, const uint32_t* slot_begin, const PairSums& sums,
                      const SurfelGradient& out, float* camera_gradient, int begin, int end) {
    const int64_t first = begin;
    const size_t count = sizeof(float) * static_cast<size_t>(end - begin);
    __builtin_memset(out.means + 3 * first, 0, 3 * count);
    __builtin_memset(out.tangents + 6 * first, 0, 6 * count);
    __builtin_memset(out.opacities + first, 0, count);
    if (out.colors) {
        __builtin_memset(out.colors + 3 * first, 0, 3 * count);
    } else {
        const int64_t width = 3 * in.coefficients;
        __builtin_memset(out.harmonics + width * first, 0, static_cast<size_t>(width) * count);
    }

    CameraSums camera_sums;
    for (F& x : camera_sums.A) x = splat(0.0f);
    for (F& x : camera_sums.t) x = splat(0.0f);
    for (F& x : camera_sums.K2) x = splat(0.0f);
    for (F& x : camera_sums.k) x = splat(0.0f);
    for (F& x : camera_sums.center) x = splat(0.0f);

    int ids[kLanes], lanes = 0;
    alignas(64) float total[16], pixel[16][kLanes];
    alignas(64) float present[kLanes];
    for (int i = begin; i <= end; ++i) {
        if (i < end) {
            if (!collect(sums, slot_begin[i], slot_begin[i + 1], total)) continue;
            ids[lanes] = i;
            for (int k = 0; k < 16; ++k) pixel[k][lanes] = total[k];
            ++lanes;
        }
        if (lanes < kLanes && (i < end || lanes == 0)) continue;
        for (int l = 0; l < kLanes; ++l) {
            present[l] = l < lanes ? 1.0f : 0.0f;
            if (l >= lanes) {
                ids[l] = ids[0];
                for (int k = 0; k < 16; ++k) pixel[k][l] = 0.0f;
            }
        }
        const M exists = lt(splat(0.0f), load(present));
        F sums_of_pixels[16];
        for (int k = 0; k < 16; ++k) sums_of_pixels[k] = load(pixel[k]);
        const PixelSums p = pixel_sums(sums_of_pixels);
        const SurfelLanes s = load_lanes(in, ids);
        F d_mean[3], d_tangent[6];
        LaneGradient lane_gradient;
        differentiate(camera, s, make_geometry(camera, s), p, exists, camera_sums, d_mean, d_tangent);
        if (in.harmonics) {
            differentiate_lane_harmonics(camera, in, ids, s.mean, p.color, exists, camera_sums, d_mean, lane_gradient);
        }
        for (int k = 0; k < 3; ++k) store(lane_gradient.mean[k], d_mean[k]);
        for (int k = 0; k < 6; ++k) store(lane_gradient.tangent[k], d_tangent[k]);
        store(lane_gradient.opacity, p.opacity);
        for (int k = 0; k < 3; ++k) store(lane_gradient.color[k], p.color[k]);
        scatter(lane_gradient, ids, lanes, in, out);
        lanes = 0;
    }
    for (int k = 0; k < 9; ++k) camera_gradient[k] = sum(camera_sums.A[k]);
    for (int k = 0; k < 3; ++k) camera_gradient[9 + k] = sum(camera_sums.t[k]);
    for (int k = 0; k < 4; ++k) camera_gradient[12 + k] = sum(camera_sums.K2[k]);
    for (int k = 0; k < 2; ++k) camera_gradient[16 + k] = sum(camera_sums.k[k]);
    for (int k = 0; k < 3; ++k) camera_gradient[18 + k] = sum(camera_sums.center[k]);
}

}  // namespace mass::MASS_ISA
