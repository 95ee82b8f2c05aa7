// Sums over pixels -> gradients of the surfels and of the camera.
#pragma once

#include "geometry.hpp"
#include "harmonics.hpp"
#include "reduce.hpp"

namespace mass::MASS_ISA {

struct PixelSums {
    F color[3], opacity;
    F a1, a2, b1, b2, g1, g2, zc;
    F mx, my, normal[3];
};

// Adds a surfel's pairs in slot order.
MASS_INLINE bool collect(const PairSums& in, uint32_t begin, uint32_t end, float* total) {
    bool found = false;
    for (uint32_t slot = begin; slot < end; ++slot) {
        if (!in.touched[slot]) continue;
        if (!found) {
            for (int k = 0; k < 16; ++k) total[k] = 0.0f;
            found = true;
        }
        const float* g = &in.gradient[slot].r;
        for (int k = 0; k < 16; ++k) total[k] += g[k];
    }
    return found;
}

struct CameraSums {
    F A[9], t[3], K2[4], k[2], center[3];
};

MASS_INLINE void add_outer(F* A, const F* y, const F* x) {  // A += y x^T
    for (int r = 0; r < 3; ++r) {
        for (int c = 0; c < 3; ++c) A[3 * r + c] = fma(y[r], x[c], A[3 * r + c]);
    }
}

struct LaneGradient {
    alignas(64) float mean[3][kLanes], tangent[6][kLanes], opacity[kLanes], color[3][kLanes], harmonics[48][kLanes];
};

// The chain rule through make_geometry, in reverse order.
MASS_INLINE void differentiate(const CameraData& camera, const SurfelLanes& s, const Geometry& g, const PixelSums& p,
                               M exists, CameraSums& sums, F* d_mean, F* d_tangent) {
    const F zero = splat(0.0f);
    const M solid = andnot(exists, g.edge_on);
    const F zc = g.c[2], inverse_z = div(splat(1.0f), zc);

    // a = zc G0, b = zc G1, g = -(z0 G0 + z1 G1)
    const F dG00 = fnma(g.u[2], p.g1, mul(zc, p.a1)), dG01 = fnma(g.u[2], p.g2, mul(zc, p.a2));
    const F dG10 = fnma(g.v[2], p.g1, mul(zc, p.b1)), dG11 = fnma(g.v[2], p.g2, mul(zc, p.b2));
    F du[3], dv[3], dc[3];
    du[2] = neg(keep(solid, fma(g.G00, p.g1, mul(g.G01, p.g2))));
    dv[2] = neg(keep(solid, fma(g.G10, p.g1, mul(g.G11, p.g2))));
    const F d_factor = fma(p.a1, g.G00, fma(p.a2, g.G01, fma(p.b1, g.G10, mul(p.b2, g.G11))));
    dc[2] = add(p.zc, keep(solid, d_factor));

    // dJ = -G^T dG G^T
    const F P00 = fma(dG00, g.G00, mul(dG01, g.G01)), P01 = fma(dG00, g.G10, mul(dG01, g.G11));
    const F P10 = fma(dG10, g.G00, mul(dG11, g.G01)), P11 = fma(dG10, g.G10, mul(dG11, g.G11));
    const F dJ00 = neg(keep(solid, fma(g.G00, P00, mul(g.G10, P10))));
    const F dJ01 = neg(keep(solid, fma(g.G00, P01, mul(g.G10, P11))));
    const F dJ10 = neg(keep(solid, fma(g.G01, P00, mul(g.G11, P10))));
    const F dJ11 = neg(keep(solid, fma(g.G01, P01, mul(g.G11, P11))));

    // J = K2 Jn, (mx, my) = K2 (nx, ny) + k
    const F k00 = splat(camera.K2[0]), k01 = splat(camera.K2[1]);
    const F k10 = splat(camera.K2[2]), k11 = splat(camera.K2[3]);
    const F dn00 = fma(k00, dJ00, mul(k10, dJ10)), dn01 = fma(k00, dJ01, mul(k10, dJ11));
    const F dn10 = fma(k01, dJ00, mul(k11, dJ10)), dn11 = fma(k01, dJ01, mul(k11, dJ11));
    F d_nx = fma(k00, p.mx, mul(k10, p.my)), d_ny = fma(k01, p.mx, mul(k11, p.my));
    const F dK[4] = {fma(dJ00, g.jn00, fma(dJ01, g.jn01, mul(p.mx, g.nx))), fma(dJ00, g.jn10, fma(dJ01, g.jn11, mul(p.mx, g.ny))),
                     fma(dJ10, g.jn00, fma(dJ11, g.jn01, mul(p.my, g.nx))), fma(dJ10, g.jn10, fma(dJ11, g.jn11, mul(p.my, g.ny)))};
    for (int k = 0; k < 4; ++k) sums.K2[k] = add(sums.K2[k], keep(exists, dK[k]));
    sums.k[0] = add(sums.k[0], keep(exists, p.mx));
    sums.k[1] = add(sums.k[1], keep(exists, p.my));

    // Jn column i = (x_i - nx z_i, y_i - ny z_i)
    du[0] = dn00;
    du[1] = dn10;
    du[2] = fnma(g.nx, dn00, fnma(g.ny, dn10, du[2]));
    dv[0] = dn01;
    dv[1] = dn11;
    dv[2] = fnma(g.nx, dn01, fnma(g.ny, dn11, dv[2]));
    d_nx = fnma(dn00, g.u[2], fnma(dn01, g.v[2], d_nx));
    d_ny = fnma(dn10, g.u[2], fnma(dn11, g.v[2], d_ny));
    dc[0] = mul(d_nx, inverse_z);
    dc[1] = mul(d_ny, inverse_z);
    dc[2] = sub(dc[2], mul(inverse_z, fma(g.nx, d_nx, mul(g.ny, d_ny))));

    // The blended normal is +-n / |n| with n = u x v.
    const F inverse_length = div(select(lt(zero, g.facing), splat(-1.0f), splat(1.0f)), sqrt(g.normal2));
    const F along = div(dot3(p.normal, g.n), g.normal2);
    F dn[3], from_u[3], from_v[3];
    for (int k = 0; k < 3; ++k) dn[k] = keep(exists, mul(inverse_length, fnma(along, g.n[k], p.normal[k])));
    cross3(g.v, dn, from_u);
    cross3(dn, g.u, from_v);
    for (int k = 0; k < 3; ++k) {
        du[k] = keep(exists, add(du[k], from_u[k]));
        dv[k] = keep(exists, add(dv[k], from_v[k]));
        dc[k] = keep(exists, dc[k]);
        sums.t[k] = add(sums.t[k], dc[k]);
    }
    add_outer(sums.A, dc, s.mean);
    add_outer(sums.A, du, s.tangent);
    add_outer(sums.A, dv, s.tangent + 3);
    rotate_back(camera.A, dc, d_mean);
    rotate_back(camera.A, du, d_tangent);
    rotate_back(camera.A, dv, d_tangent + 3);
}

// Through the harmonics, from the gradient of the clamped colour; adds to the gradient of the mean.
MASS_INLINE void differentiate_harmonics(const CameraData& camera, const SurfelData& in, const int* ids, const F* mean,
                                         const F* d_color, M exists, CameraSums& sums, F* d_mean, LaneGradient& out) {
    const int K = in.coefficients;
    alignas(64) float lanes[48][kLanes];
    for (int l = 0; l < kLanes; ++l) {
        const float* from = in.harmonics + static_cast<int64_t>(ids[l]) * 3 * K;
        for (int k = 0; k < 3 * K; ++k) lanes[k][l] = from[k];
    }
    F Y[16], d[3], h[48], color[3], free[3], along[16];
    const F inverse_distance = view_direction(camera, mean, d);
    harmonic_basis(d, K, Y);
    for (int k = 0; k < 3 * K; ++k) h[k] = load(lanes[k]);
    harmonic_color(Y, h, K, color);
    for (int c = 0; c < 3; ++c) free[c] = keep(both(exists, lt(splat(0.0f), color[c])), d_color[c]);
    for (int k = 0; k < K; ++k) {
        along[k] = splat(0.0f);
        for (int c = 0; c < 3; ++c) {
            store(out.harmonics[3 * k + c], mul(Y[k], free[c]));
            along[k] = fma(h[3 * k + c], free[c], along[k]);
        }
    }
    if (K == 1) return;
    F dd[3];
    harmonic_gradient(d, K, along, dd);
    const F radial = dot3(d, dd);
    for (int k = 0; k < 3; ++k) {
        const F moved = keep(exists, mul(inverse_distance, fnma(radial, d[k], dd[k])));
        d_mean[k] = add(d_mean[k], moved);
        sums.center[k] = sub(sums.center[k], moved);
    }
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
        PixelSums p;
        for (int k = 0; k < 3; ++k) p.color[k] = load(pixel[k]);
        p.opacity = load(pixel[3]);
        p.a1 = load(pixel[4]);
        p.a2 = load(pixel[5]);
        p.b1 = load(pixel[6]);
        p.b2 = load(pixel[7]);
        p.g1 = load(pixel[8]);
        p.g2 = load(pixel[9]);
        p.zc = load(pixel[10]);
        p.mx = load(pixel[11]);
        p.my = load(pixel[12]);
        for (int k = 0; k < 3; ++k) p.normal[k] = load(pixel[13 + k]);
        const SurfelLanes s = load_lanes(in, ids);
        F d_mean[3], d_tangent[6];
        LaneGradient lane_gradient;
        differentiate(camera, s, make_geometry(camera, s), p, exists, camera_sums, d_mean, d_tangent);
        if (in.harmonics) {
            differentiate_harmonics(camera, in, ids, s.mean, p.color, exists, camera_sums, d_mean, lane_gradient);
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
