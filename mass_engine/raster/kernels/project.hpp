// World surfels -> splats, pixel bounds and sort keys.
#pragma once

#include "bounds.hpp"
#include "harmonics.hpp"
#include "lanes.hpp"
#include "reduce.hpp"

namespace mass::MASS_ISA {

// The clamped colours of surfels first .. first + 15, or NaN where a coefficient is no number.
MASS_INLINE void harmonic_colors(const CameraData& camera, const SurfelData& in, int64_t first, const int* ids,
                                 SurfelLanes& s, F* clamped) {
    const int K = in.coefficients;
    F Y[16], d[3], h[48];
    view_direction(camera, s.mean, d);
    harmonic_basis(d, K, Y);
    if (ids) {
        alignas(64) float lanes[48][kLanes];
        for (int l = 0; l < kLanes; ++l) {
            const float* from = in.harmonics + static_cast<int64_t>(ids[l]) * 3 * K;
            for (int k = 0; k < 3 * K; ++k) lanes[k][l] = from[k];
        }
        for (int k = 0; k < 3 * K; ++k) h[k] = load(lanes[k]);
    } else {
        for (int k = 0; k < 3 * K; ++k) h[k] = gather(in.harmonics + first * 3 * K + k, 3 * K);
    }
    harmonic_color(Y, h, K, s.color);
    for (int c = 0; c < 3; ++c) clamped[c] = max(s.color[c], splat(0.0f));
}

int project(const CameraData& camera, const SurfelData& in, const ProjectedData& out, int begin, int end) {
    int dropped = 0;
    for (int first = begin; first < end; first += kLanes) {
        const int lanes = end - first < kLanes ? end - first : kLanes;
        int ids[kLanes];
        for (int l = 0; l < kLanes; ++l) ids[l] = first + (l < lanes ? l : 0);
        const bool whole = lanes == kLanes;
        if (first + 9 * kLanes <= in.count) prefetch_run(in, first + 8 * kLanes);
        SurfelLanes s = whole ? load_run(in, first) : load_lanes(in, ids);
        F color[3] = {s.color[0], s.color[1], s.color[2]};
        if (in.harmonics) harmonic_colors(camera, in, first, whole ? nullptr : ids, s, color);
        const Geometry g = make_geometry(camera, s);
        const F zc = g.c[2];

        const Placement place = place_surfel(camera, s, g);
        const PixelBounds& b = place.bounds;

        const unsigned exists = (1u << lanes) - 1u;
        const unsigned bad = bits(g.bad) & exists;
        dropped += __builtin_popcount(bad);
        const unsigned visible = bits(place.seen) & exists;

        alignas(64) float bounds[4][kLanes], depth[kLanes], normal[3][kLanes];
        alignas(64) Box box[kLanes];
        alignas(64) float box_low[kLanes], box_high[kLanes];
        store(depth, zc);
        store(bounds[0], b.x0);
        store(bounds[1], b.x1);
        store(bounds[2], b.y0);
        store(bounds[3], b.y1);
        for (int l = 0; l < kLanes; ++l) {
            const bool shown = visible >> l & 1u;
            box[l] = {static_cast<int16_t>(shown ? bounds[0][l] : 0), static_cast<int16_t>(shown ? bounds[1][l] : -1),
                      static_cast<int16_t>(shown ? bounds[2][l] : 0), static_cast<int16_t>(shown ? bounds[3][l] : -1)};
            __builtin_memcpy(&box_low[l], &box[l].x0, 4);
            __builtin_memcpy(&box_high[l], &box[l].y0, 4);
        }
        __builtin_memcpy(out.boxes + first, box, sizeof(Box) * static_cast<size_t>(lanes));
        __builtin_memcpy(out.keys + first, depth, sizeof(float) * static_cast<size_t>(lanes));
        if (visible == 0) continue;

        const M narrow = camera.without & kWithoutShortPath ? g.edge_on : low_pass_only(g, place.reach, b.crossing);
        F rows[kLanes] = {g.mx, g.my, g.a1, g.a2, g.b1, g.b2, g.g1, g.g2, zc, s.opacity, color[0], color[1], color[2],
                          keep(narrow, splat(1.0f)), load(box_low), load(box_high)};
        transpose16(rows);
        for (int l = 0; l < lanes; ++l) store(&out.splats[first + l].mx, rows[l]);
        if (out.normals) {
            F towards[3];
            normal_to_camera(g, towards);
            for (int k = 0; k < 3; ++k) store(normal[k], towards[k]);
            for (int l = 0; l < lanes; ++l) out.normals[first + l] = {normal[0][l], normal[1][l], normal[2][l], 0.0f};
        }
    }
    return dropped;
}

}  // namespace mass::MASS_ISA
