// Sums over pixels -> gradients of the surfels and of the camera.
#pragma once

#include "geometry.hpp"
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
    F A[9], t[3], K2[4], k[2];
};

MASS_INLINE void add_outer(F* A, const F* y, const F* x) {  // A += y x^T
    for (int r = 0; r < 3; ++r) {
        for (int c = 0; c < 3; ++c) A[3 * r + c] = fma(y[r], x[c], A[3 * r + c]);
    }
}

struct LaneGradient {
    float mean[3][kLanes], quat[4][kLanes], scale[2][kLanes], opacity[kLanes], color[3][kLanes];
};

// The chain rule through make_geometry, in reverse order.
MASS_INLINE void differentiate(const CameraData& camera, const SurfelLanes& s, const Geometry& g, const PixelSums& p,
                               M exists, CameraSums& sums, LaneGradient& out) {
    const F zero = splat(0.0f);
    const M all = le(zero, zero);
    const M solid = andnot(all, g.edge_on);
    const F zc = g.c[2], inverse_z = div(splat(1.0f), zc);

    // a = zc G0 / su, b = zc G1 / sv, g = -(z0 G0 + z1 G1)
    const F iu = div(splat(1.0f), s.scale[0]), iv = div(splat(1.0f), s.scale[1]);
    const F ku = mul(zc, iu), kv = mul(zc, iv);
    const F d_su = neg(mul(iu, keep(solid, fma(p.a1, g.a1, mul(p.a2, g.a2)))));
    const F d_sv = neg(mul(iv, keep(solid, fma(p.b1, g.b1, mul(p.b2, g.b2)))));
    const F dG00 = fnma(g.u[2], p.g1, mul(ku, p.a1)), dG01 = fnma(g.u[2], p.g2, mul(ku, p.a2));
    const F dG10 = fnma(g.v[2], p.g1, mul(kv, p.b1)), dG11 = fnma(g.v[2], p.g2, mul(kv, p.b2));
    F du[3], dv[3], dc[3];
    du[2] = neg(keep(solid, fma(g.G00, p.g1, mul(g.G01, p.g2))));
    dv[2] = neg(keep(solid, fma(g.G10, p.g1, mul(g.G11, p.g2))));
    dc[2] = add(p.zc, mul(inverse_z, keep(solid, fma(p.a1, g.a1, fma(p.a2, g.a2, fma(p.b1, g.b1, mul(p.b2, g.b2)))))));

    // dJ = -G^T dG G^T
    const F P00 = fma(dG00, g.G00, mul(dG01, g.G01)), P01 = fma(dG00, g.G10, mul(dG01, g.G11));
    const F P10 = fma(dG10, g.G00, mul(dG11, g.G01)), P11 = fma(dG10, g.G10, mul(dG11, g.G11));
    const F dJ00 = neg(keep(solid, fma(g.G00, P00, mul(g.G10, P10)))), dJ01 = neg(keep(solid, fma(g.G00, P01, mul(g.G10, P11))));
    const F dJ10 = neg(keep(solid, fma(g.G01, P00, mul(g.G11, P10)))), dJ11 = neg(keep(solid, fma(g.G01, P01, mul(g.G11, P11))));

    // J = K2 Jn, (mx, my) = K2 (nx, ny) + k
    const F k00 = splat(camera.K2[0]), k01 = splat(camera.K2[1]), k10 = splat(camera.K2[2]), k11 = splat(camera.K2[3]);
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

    const F sign = select(lt(zero, g.facing), splat(-1.0f), splat(1.0f));
    F dn[3];
    for (int k = 0; k < 3; ++k) {
        dn[k] = keep(exists, mul(sign, p.normal[k]));
        du[k] = keep(exists, du[k]);
        dv[k] = keep(exists, dv[k]);
        dc[k] = keep(exists, dc[k]);
        sums.t[k] = add(sums.t[k], dc[k]);
    }
    add_outer(sums.A, dc, s.mean);
    add_outer(sums.A, du, g.axis_u);
    add_outer(sums.A, dv, g.axis_v);
    add_outer(sums.A, dn, g.axis_n);

    F world[3], U[3], V[3], N[3];
    rotate_back(camera.A, dc, world);
    rotate_back(camera.A, du, U);
    rotate_back(camera.A, dv, V);
    rotate_back(camera.A, dn, N);

    // Unit quaternion -> rotation columns, then through the normalisation.
    const F w = g.q[0], x = g.q[1], y = g.q[2], z = g.q[3], two = splat(2.0f);
    const F q[4] = {
        mul(two, fma(z, sub(U[1], V[0]), fma(y, sub(N[0], U[2]), mul(x, sub(V[2], N[1]))))),
        mul(two, fma(y, add(U[1], V[0]), fma(z, add(U[2], N[0]), fma(w, sub(V[2], N[1]), mul(mul(splat(-2.0f), x), add(V[1], N[2])))))),
        mul(two, fma(x, add(U[1], V[0]), fma(z, add(V[2], N[1]), fma(w, sub(N[0], U[2]), mul(mul(splat(-2.0f), y), add(U[0], N[2])))))),
        mul(two, fma(x, add(U[2], N[0]), fma(y, add(V[2], N[1]), fma(w, sub(U[1], V[0]), mul(mul(splat(-2.0f), z), add(U[0], V[1])))))),
    };
    const F along = fma(w, q[0], fma(x, q[1], fma(y, q[2], mul(z, q[3]))));
    for (int k = 0; k < 4; ++k) store(out.quat[k], mul(g.inverse_norm, fnma(g.q[k], along, q[k])));
    for (int k = 0; k < 3; ++k) store(out.mean[k], world[k]);
    store(out.scale[0], d_su);
    store(out.scale[1], d_sv);
    store(out.opacity, p.opacity);
    for (int k = 0; k < 3; ++k) store(out.color[k], p.color[k]);
}

MASS_INLINE void scatter(const LaneGradient& g, const int* ids, int count, const SurfelGradient& out) {
    for (int l = 0; l < count; ++l) {
        const int64_t i = ids[l];
        for (int k = 0; k < 3; ++k) out.means[3 * i + k] = g.mean[k][l];
        for (int k = 0; k < 4; ++k) out.quats[4 * i + k] = g.quat[k][l];
        for (int k = 0; k < 2; ++k) out.scales[2 * i + k] = g.scale[k][l];
        out.opacities[i] = g.opacity[l];
        for (int k = 0; k < 3; ++k) out.colors[3 * i + k] = g.color[k][l];
    }
}

void project_backward(const CameraData& camera, const SurfelData& in, const uint32_t* slot_begin, const PairSums& sums,
                      const SurfelGradient& out, float* camera_gradient, int begin, int end) {
    const int64_t first = begin, count = end - begin;
    __builtin_memset(out.means + 3 * first, 0, sizeof(float) * 3 * static_cast<size_t>(count));
    __builtin_memset(out.quats + 4 * first, 0, sizeof(float) * 4 * static_cast<size_t>(count));
    __builtin_memset(out.scales + 2 * first, 0, sizeof(float) * 2 * static_cast<size_t>(count));
    __builtin_memset(out.opacities + first, 0, sizeof(float) * static_cast<size_t>(count));
    __builtin_memset(out.colors + 3 * first, 0, sizeof(float) * 3 * static_cast<size_t>(count));

    CameraSums camera_sums;
    for (F& x : camera_sums.A) x = splat(0.0f);
    for (F& x : camera_sums.t) x = splat(0.0f);
    for (F& x : camera_sums.K2) x = splat(0.0f);
    for (F& x : camera_sums.k) x = splat(0.0f);

    int ids[kLanes], lanes = 0;
    alignas(64) float total[16], pixel[16][kLanes];
    alignas(64) float exists[kLanes];
    for (int i = begin; i <= end; ++i) {
        if (i < end) {
            if (!collect(sums, slot_begin[i], slot_begin[i + 1], total)) continue;
            ids[lanes] = i;
            for (int k = 0; k < 16; ++k) pixel[k][lanes] = total[k];
            ++lanes;
        }
        if (lanes < kLanes && (i < end || lanes == 0)) continue;
        for (int l = 0; l < kLanes; ++l) {
            exists[l] = l < lanes ? 1.0f : 0.0f;
            if (l >= lanes) {
                ids[l] = ids[0];
                for (int k = 0; k < 16; ++k) pixel[k][l] = 0.0f;
            }
        }
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
        LaneGradient lane_gradient;
        differentiate(camera, s, make_geometry(camera, s), p, lt(splat(0.0f), load(exists)), camera_sums, lane_gradient);
        scatter(lane_gradient, ids, lanes, out);
        lanes = 0;
    }
    for (int k = 0; k < 9; ++k) camera_gradient[k] = sum(camera_sums.A[k]);
    for (int k = 0; k < 3; ++k) camera_gradient[9 + k] = sum(camera_sums.t[k]);
    for (int k = 0; k < 4; ++k) camera_gradient[12 + k] = sum(camera_sums.K2[k]);
    for (int k = 0; k < 2; ++k) camera_gradient[16 + k] = sum(camera_sums.k[k]);
}

}  // namespace mass::MASS_ISA
