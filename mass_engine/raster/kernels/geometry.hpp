// From a surfel in the world to its map from pixels to disk coordinates, sixteen surfels at a time.
//
// A surfel is its centre and two tangents, conjugate half-diameters of its one-sigma ellipse: mean + u t0 + v t1.
// The 2DGS splat-to-pixel matrix (Huang et al. 2024, eq. 7-9), written relative to the projected centre: with J the
// derivative of the pixel by (u, v) times depth, G its inverse and d = pixel - centre,
//   pz = 1 + g.d,  u = zc (G0.d) / pz,  v = zc (G1.d) / pz,  depth = zc / pz,  g = -(z0 G0 + z1 G1).
// Nothing cancels near the centre, where most pixels are, so float32 is enough.
#pragma once

#include "simd.hpp"
#include "types.hpp"

namespace mass::MASS_ISA {

struct SurfelLanes {
    F mean[3], tangent[6], opacity, color[3];
};

struct Geometry {
    F c[3], u[3], v[3], n[3];  // camera: centre, tangents, normal (their product: neither unit nor flipped)
    F nx, ny, mx, my;          // normalised and pixel centre
    F jn00, jn01, jn10, jn11;  // J before K
    F G00, G01, G10, G11;      // inverse of J
    F a1, a2, b1, b2, g1, g2;
    F facing, normal2;  // n.c, n.n
    M bad, edge_on;
};

MASS_INLINE F dot3(const F* a, const F* b) { return fma(a[0], b[0], fma(a[1], b[1], mul(a[2], b[2]))); }

MASS_INLINE void cross3(const F* a, const F* b, F* out) {
    out[0] = fnma(a[2], b[1], mul(a[1], b[2]));
    out[1] = fnma(a[0], b[2], mul(a[2], b[0]));
    out[2] = fnma(a[1], b[0], mul(a[0], b[1]));
}

MASS_INLINE void rotate(const float* A, const F* x, F* y) {
    for (int r = 0; r < 3; ++r) {
        y[r] = fma(splat(A[3 * r]), x[0], fma(splat(A[3 * r + 1]), x[1], mul(splat(A[3 * r + 2]), x[2])));
    }
}

MASS_INLINE void rotate_back(const float* A, const F* y, F* x) {
    for (int r = 0; r < 3; ++r) {
        x[r] = fma(splat(A[r]), y[0], fma(splat(A[3 + r]), y[1], mul(splat(A[6 + r]), y[2])));
    }
}

MASS_INLINE Geometry make_geometry(const CameraData& camera, const SurfelLanes& s) {
    Geometry o;
    const F zero = splat(0.0f), one = splat(1.0f);

    rotate(camera.A, s.mean, o.c);
    for (int k = 0; k < 3; ++k) o.c[k] = add(o.c[k], splat(camera.t[k]));
    rotate(camera.A, s.tangent, o.u);
    rotate(camera.A, s.tangent + 3, o.v);
    cross3(o.u, o.v, o.n);
    o.facing = dot3(o.n, o.c);
    o.normal2 = dot3(o.n, o.n);

    const F zc = o.c[2], inverse_z = div(one, zc);
    o.nx = mul(o.c[0], inverse_z);
    o.ny = mul(o.c[1], inverse_z);
    const F k00 = splat(camera.K2[0]), k01 = splat(camera.K2[1]);
    const F k10 = splat(camera.K2[2]), k11 = splat(camera.K2[3]);
    o.mx = fma(k00, o.nx, fma(k01, o.ny, splat(camera.k[0])));
    o.my = fma(k10, o.nx, fma(k11, o.ny, splat(camera.k[1])));

    o.jn00 = fnma(o.nx, o.u[2], o.u[0]);
    o.jn10 = fnma(o.ny, o.u[2], o.u[1]);
    o.jn01 = fnma(o.nx, o.v[2], o.v[0]);
    o.jn11 = fnma(o.ny, o.v[2], o.v[1]);
    const F J00 = fma(k00, o.jn00, mul(k01, o.jn10)), J01 = fma(k00, o.jn01, mul(k01, o.jn11));
    const F J10 = fma(k10, o.jn00, mul(k11, o.jn10)), J11 = fma(k10, o.jn01, mul(k11, o.jn11));
    const F det = fnma(J01, J10, mul(J00, J11));
    const F inverse_det = div(one, det);
    o.G00 = mul(J11, inverse_det);
    o.G01 = neg(mul(J01, inverse_det));
    o.G10 = neg(mul(J10, inverse_det));
    o.G11 = mul(J00, inverse_det);
    o.a1 = mul(zc, o.G00);
    o.a2 = mul(zc, o.G01);
    o.b1 = mul(zc, o.G10);
    o.b2 = mul(zc, o.G11);
    o.g1 = neg(fma(o.u[2], o.G00, mul(o.v[2], o.G10)));
    o.g2 = neg(fma(o.u[2], o.G01, mul(o.v[2], o.G11)));

    // x * 0 is 0 for a number and NaN for NaN and infinities.
    F probe = mul(s.opacity, zero);
    for (int k = 0; k < 3; ++k) probe = fma(s.mean[k], zero, fma(s.color[k], zero, probe));
    for (int k = 0; k < 6; ++k) probe = fma(s.tangent[k], zero, probe);
    const F least = mul(splat(kLeastSine2), mul(dot3(o.u, o.u), dot3(o.v, o.v)));
    const M fine = both(eq(probe, zero), lt(max(splat(kLeastArea2), least), o.normal2));
    const F limit = mul(mul(splat(kEdgeOnCosine * kEdgeOnCosine), dot3(o.c, o.c)), o.normal2);
    const F sizes = fma(o.a1, zero, fma(o.a2, zero, fma(o.b1, zero, mul(o.b2, zero))));
    const M solid = both(lt(limit, mul(o.facing, o.facing)), eq(fma(o.g1, zero, fma(o.g2, zero, sizes)), zero));
    const M all = le(zero, zero);
    o.bad = andnot(all, fine);
    o.edge_on = andnot(all, solid);
    return o;
}

}  // namespace mass::MASS_ISA
