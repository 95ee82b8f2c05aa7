// Surfels from their arrays into lanes: sixteen that follow one another, or any sixteen.
#pragma once

#include "geometry.hpp"

namespace mass::MASS_ISA {

// Lanes that do not exist repeat the first one.
MASS_INLINE SurfelLanes load_lanes(const SurfelData& in, const int* ids) {
    alignas(64) float x[13][kLanes];
    for (int l = 0; l < kLanes; ++l) {
        const int64_t i = ids[l];
        for (int k = 0; k < 3; ++k) x[k][l] = in.means[3 * i + k];
        for (int k = 0; k < 6; ++k) x[3 + k][l] = in.tangents[6 * i + k];
        x[9][l] = in.opacities[i];
        for (int k = 0; k < 3; ++k) x[10 + k][l] = in.colors ? in.colors[3 * i + k] : 0.0f;
    }
    SurfelLanes s;
    for (int k = 0; k < 3; ++k) s.mean[k] = load(x[k]);
    for (int k = 0; k < 6; ++k) s.tangent[k] = load(x[3 + k]);
    s.opacity = load(x[9]);
    for (int k = 0; k < 3; ++k) s.color[k] = load(x[10 + k]);
    return s;
}

// The hardware does not follow gathers over several arrays; a hint per cache line some groups ahead does.
MASS_INLINE void prefetch_run(const SurfelData& in, int64_t i) {
    for (int k = 0; k < 3; ++k) __builtin_prefetch(in.means + 3 * i + 16 * k);
    for (int k = 0; k < 6; ++k) __builtin_prefetch(in.tangents + 6 * i + 16 * k);
    __builtin_prefetch(in.opacities + i);
    if (in.colors) {
        for (int k = 0; k < 3; ++k) __builtin_prefetch(in.colors + 3 * i + 16 * k);
    }
}

MASS_INLINE SurfelLanes load_run(const SurfelData& in, int begin) {
    const int64_t i = begin;
    SurfelLanes s;
    for (int k = 0; k < 3; ++k) s.mean[k] = gather(in.means + 3 * i + k, 3);
    for (int k = 0; k < 6; ++k) s.tangent[k] = gather(in.tangents + 6 * i + k, 6);
    s.opacity = load(in.opacities + i);
    for (int k = 0; k < 3; ++k) s.color[k] = in.colors ? gather(in.colors + 3 * i + k, 3) : splat(0.0f);
    return s;
}

}  // namespace mass::MASS_ISA
