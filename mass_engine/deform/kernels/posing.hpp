// From a posed mesh to surfels ready for the rasteriser in one pass, sixteen at a time: registered in their triangles,
// deformed, shaded. mass_engine/deform/posing.py says it in plain torch.
#pragma once

#include "decoder.hpp"
#include "harmonics.hpp"
#include "lookup.hpp"
#include "posing_types.hpp"
#include "residuals.hpp"

namespace mass::MASS_ISA {

// min(1, 2 / (1 + e^-x))
MASS_INLINE F opacity_mask(F x) {
    const F q = exp_neg(min(x, splat(0.0f)));
    return div(add(q, q), add(splat(1.0f), q));
}

struct Surfels {
    V3 mean, first, second, normal;
    F opacity;
};

MASS_INLINE V3 vertex(const PosingData& d, int corner, int n) {
    const int32_t* index = d.corners + static_cast<long>(corner) * d.stride + n;
    return {gather_at(d.vertices, index), gather_at(d.vertices + 1, index), gather_at(d.vertices + 2, index)};
}

// Surfels n .. n + 15 as attached to the mesh.
MASS_INLINE Surfels attached(const PosingData& d, int n) {
    const V3 a = vertex(d, 0, n), ab = sub(vertex(d, 1, n), a), ac = sub(vertex(d, 2, n), a);
    const auto combine = [&](int row) {
        const F kb = pick(d.coefficients + row * kTable, d.places + n), kc = pick(d.coefficients + (row + 1) * kTable, d.places + n);
        return fma(kb, ab, mul(kc, ac));
    };
    Surfels s;
    s.mean = add(a, combine(0));
    s.first = combine(2);
    s.second = combine(4);
    const V3 across = cross(ab, ac);
    s.normal = mul(div(splat(1.0f), safe_length(across)), across);
    s.opacity = load(d.opacities + n);
    return s;
}

// Change them by the decoder's outputs [16 surfels,16].
MASS_INLINE void deform(const PosingData& d, const float* block, Surfels& s) {
    const Outputs o = residuals_of(d.decoder, block);
    const Change change = {{o.offset[0], o.offset[1], o.offset[2]},
                           exp_any(o.log_scale[0]),
                           exp_any(o.log_scale[1]),
                           {o.rotation[0], o.rotation[1], o.rotation[2]}};
    apply(change, s.mean, s.first, s.second, s.normal);
    s.opacity = mul(s.opacity, opacity_mask(o.mask_logit));
}

// Change them by their static residuals.
MASS_INLINE void settle(const PosingData& d, int n, Surfels& s) {
    const auto plane = [&](long k) { return load(d.fixed + k * d.stride + n); };
    const Change change = {{plane(0), plane(1), plane(2)}, plane(3), plane(4), {plane(5), plane(6), plane(7)}};
    apply(change, s.mean, s.first, s.second, s.normal);
}

MASS_INLINE void shade(const PosingData& d, const Surfels& s, int n, F* color) {
    const F x = s.normal.x, y = s.normal.y, z = s.normal.z, zero = splat(0.0f);
    const F basis[9] = {splat(1.0f), y, z, x, mul(x, y), mul(y, z), fma(mul(splat(3.0f), z), z, splat(-1.0f)), mul(x, z),
                        fnma(y, y, mul(x, x))};
    for (int c = 0; c < 3; ++c) {
        F light = zero;
        for (int k = 0; k < 9; ++k) light = fma(basis[k], splat(d.light[3 * k + c]), light);
        color[c] = mul(load(d.albedo + static_cast<long>(c) * d.stride + n), max(light, zero));
    }
    if (d.harmonics_count == 0) return;
    const V3 away = {sub(s.mean.x, splat(d.center[0])), sub(s.mean.y, splat(d.center[1])), sub(s.mean.z, splat(d.center[2]))};
    const V3 seen = mul(div(splat(1.0f), max(sqrt(dot(away, away)), splat(1e-12f))), away);
    F turned[3], Y[16];
    for (int j = 0; j < 3; ++j) {
        const auto entry = [&](int i) { return pick(d.rotations + (3 * i + j) * kTable, d.bones + n); };
        turned[j] = fma(seen.x, entry(0), fma(seen.y, entry(1), mul(seen.z, entry(2))));
    }
    harmonic_basis(turned, d.harmonics_count + 1, Y);
    for (int c = 0; c < 3; ++c) {
        for (int k = 0; k < d.harmonics_count; ++k) {
            color[c] = fma(Y[k + 1], load(d.harmonics + static_cast<long>(3 * k + c) * d.stride + n), color[c]);
        }
        color[c] = max(color[c], zero);
    }
}

MASS_INLINE void finish(const PosingData& d, const PosedData& out, const Surfels& s, int n, int count) {
    F color[3];
    shade(d, s, n, color);
    const F mean[3] = {s.mean.x, s.mean.y, s.mean.z}, normal[3] = {s.normal.x, s.normal.y, s.normal.z};
    const F tangents[6] = {s.first.x, s.first.y, s.first.z, s.second.x, s.second.y, s.second.z};
    const long row = n;
    interleave<3>(mean, count, out.means + 3 * row);
    interleave<6>(tangents, count, out.tangents + 6 * row);
    interleave<3>(normal, count, out.normals + 3 * row);
    interleave<3>(color, count, out.colors + 3 * row);
    interleave<1>(&s.opacity, count, out.opacities + row);
}

// Surfels [begin, end).
inline void pose_surfels(const PosingData& d, const PosedData& out, int begin, int end) {
    const int plain = d.deformed_from < end ? d.deformed_from : end;
    for (int n = begin; n < plain; n += kLanes) {
        Surfels s = attached(d, n);
        if (d.fixed != nullptr) settle(d, n, s);
        finish(d, out, s, n, plain - n < kLanes ? plain - n : kLanes);
    }
    alignas(64) float outputs[kBlockRows * kPaddedOutputs];
    for (int first = begin > plain ? begin : plain; first < end; first += kBlockRows) {
        const int count = end - first < kBlockRows ? end - first : kBlockRows;
        decode_block(d.decoder, 0, first - d.deformed_from, count, outputs);
        for (int k = 0; k < count; k += kLanes) {
            Surfels s = attached(d, first + k);
            deform(d, outputs + k * kPaddedOutputs, s);
            finish(d, out, s, first + k, count - k < kLanes ? count - k : kLanes);
        }
    }
}

}  // namespace mass::MASS_ISA
