// The chain rule from a surfel's sums over pixels to its inputs and the camera.
#pragma once

#include "geometry.hpp"
#include "harmonics.hpp"

namespace mass::MASS_ISA {

struct PixelSums {
    F color[3], opacity;
    F a1, a2, b1, b2, g1, g2, zc;
    F mx, my, normal[3];
};

// From PairGradient's order.
MASS_INLINE PixelSums pixel_sums(const F* x) {
    PixelSums p;
    for (int k = 0; k < 3; ++k) p.color[k] = x[k];
    p.opacity = x[3];
    p.a1 = x[4];
    p.a2 = x[5];
    p.b1 = x[6];
    p.b2 = x[7];
    p.g1 = x[8];
    p.g2 = x[9];
    p.zc = x[10];
    p.mx = x[11];
    p.my = x[12];
    for (int k = 0; k < 3; ++k) p.normal[k] = x[13 + k];
    return p;
}

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

// Through the harmonics, from the gradient of the clamped colour: that of the coefficients `h` [3 K], into d_h, and what
// adds to the gradient of the mean.
MASS_INLINE void differentiate_harmonics(const CameraData& camera, int K, const F* h, const F* mean, const F* d_color, M exists,
                                         CameraSums& sums, F* d_mean, F* d_h) {
    F Y[16], d[3], color[3], free[3], along[16];
    const F inverse_distance = view_direction(camera, mean, d);
    harmonic_basis(d, K, Y);
    harmonic_color(Y, h, K, color);
    for (int c = 0; c < 3; ++c) free[c] = keep(both(exists, lt(splat(0.0f), color[c])), d_color[c]);
    for (int k = 0; k < K; ++k) {
        along[k] = splat(0.0f);
        for (int c = 0; c < 3; ++c) {
            d_h[3 * k + c] = mul(Y[k], free[c]);
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

}  // namespace mass::MASS_ISA
