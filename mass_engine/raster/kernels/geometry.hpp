// From a surfel in the world to its map from pixels to disk coordinates, sixteen surfels at a time.
//
// The 2DGS splat-to-pixel matrix (Huang et al. 2024, eq. 7-9), written relative to the projected centre: with J the
// derivative of the pixel by the disk's unit axes (times depth), G its inverse and d = pixel - centre,
//   pz = 1 + g.d,  u = zc (G0.d) / (su pz),  v = zc (G1.d) / (sv pz),  depth = zc / pz,  g = -(z0 G0 + z1 G1).
// Nothing cancels near the centre, where most pixels are, so float32 is enough.
#pragma once

#include "simd.hpp"
#include "types.hpp"

namespace mass::MASS_ISA {

struct SurfelLanes {
    F mean[3], quat[4], scale[2], opacity, color[3];
};

struct Geometry {
    F q[4], inverse_norm;                // unit quaternion
    F axis_u[3], axis_v[3], axis_n[3];   // world
    F c[3], u[3], v[3], n[3];            // camera: centre, unit axes, normal (not flipped)
    F nx, ny, mx, my;                    // normalised and pixel centre
    F jn00, jn01, jn10, jn11;            // J before K
    F G00, G01, G10, G11;                // inverse of J
    F a1, a2, b1, b2, g1, g2;
    F facing;                            // n.c
    M bad, edge_on;
};

// Lanes that do not exist repeat the first one.
MASS_INLINE SurfelLanes load_lanes(const SurfelData& in, const int* ids) {
    float x[13][kLanes];
    for (int l = 0; l < kLanes; ++l) {
        const int64_t i = ids[l];
        for (int k = 0; k < 3; ++k) x[k][l] = in.means[3 * i + k];
        for (int k = 0; k < 4; ++k) x[3 + k][l] = in.quats[4 * i + k];
        for (int k = 0; k < 2; ++k) x[7 + k][l] = in.scales[2 * i + k];
        x[9][l] = in.opacities[i];
        for (int k = 0; k < 3; ++k) x[10 + k][l] = in.colors[3 * i + k];
    }
    SurfelLanes s;
    for (int k = 0; k < 3; ++k) s.mean[k] = load(x[k]);
    for (int k = 0; k < 4; ++k) s.quat[k] = load(x[3 + k]);
    for (int k = 0; k < 2; ++k) s.scale[k] = load(x[7 + k]);
    s.opacity = load(x[9]);
    for (int k = 0; k < 3; ++k) s.color[k] = load(x[10 + k]);
    return s;
}

// The hardware does not follow gathers over five arrays; a hint per cache line some groups ahead does.
MASS_INLINE void prefetch_run(const SurfelData& in, int64_t i) {
    for (int k = 0; k < 3; ++k) __builtin_prefetch(in.means + 3 * i + 16 * k);
    for (int k = 0; k < 4; ++k) __builtin_prefetch(in.quats + 4 * i + 16 * k);
    for (int k = 0; k < 2; ++k) __builtin_prefetch(in.scales + 2 * i + 16 * k);
    __builtin_prefetch(in.opacities + i);
    for (int k = 0; k < 3; ++k) __builtin_prefetch(in.colors + 3 * i + 16 * k);
}

MASS_INLINE SurfelLanes load_run(const SurfelData& in, int begin) {
    const int64_t i = begin;
    SurfelLanes s;
    for (int k = 0; k < 3; ++k) s.mean[k] = gather(in.means + 3 * i + k, 3);
    for (int k = 0; k < 4; ++k) s.quat[k] = gather(in.quats + 4 * i + k, 4);
    for (int k = 0; k < 2; ++k) s.scale[k] = gather(in.scales + 2 * i + k, 2);
    s.opacity = load(in.opacities + i);
    for (int k = 0; k < 3; ++k) s.color[k] = gather(in.colors + 3 * i + k, 3);
    return s;
}

MASS_INLINE F dot3(const F* a, const F* b) { return fma(a[0], b[0], fma(a[1], b[1], mul(a[2], b[2]))); }

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

    const F norm2 = fma(s.quat[0], s.quat[0], fma(s.quat[1], s.quat[1], fma(s.quat[2], s.quat[2], mul(s.quat[3], s.quat[3]))));
    o.inverse_norm = div(one, sqrt(norm2));
    for (int k = 0; k < 4; ++k) o.q[k] = mul(s.quat[k], o.inverse_norm);
    const F w = o.q[0], x = o.q[1], y = o.q[2], z = o.q[3];
    const F x2 = add(x, x), y2 = add(y, y), z2 = add(z, z);
    o.axis_u[0] = fnma(y, y2, fnma(z, z2, one));
    o.axis_u[1] = fma(x, y2, mul(w, z2));
    o.axis_u[2] = fnma(w, y2, mul(x, z2));
    o.axis_v[0] = fnma(w, z2, mul(x, y2));
    o.axis_v[1] = fnma(x, x2, fnma(z, z2, one));
    o.axis_v[2] = fma(y, z2, mul(w, x2));
    o.axis_n[0] = fma(x, z2, mul(w, y2));
    o.axis_n[1] = fnma(w, x2, mul(y, z2));
    o.axis_n[2] = fnma(x, x2, fnma(y, y2, one));

    rotate(camera.A, s.mean, o.c);
    for (int k = 0; k < 3; ++k) o.c[k] = add(o.c[k], splat(camera.t[k]));
    rotate(camera.A, o.axis_u, o.u);
    rotate(camera.A, o.axis_v, o.v);
    rotate(camera.A, o.axis_n, o.n);
    o.facing = dot3(o.n, o.c);

    const F zc = o.c[2], inverse_z = div(one, zc);
    o.nx = mul(o.c[0], inverse_z);
    o.ny = mul(o.c[1], inverse_z);
    const F k00 = splat(camera.K2[0]), k01 = splat(camera.K2[1]), k10 = splat(camera.K2[2]), k11 = splat(camera.K2[3]);
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
    const F ku = div(zc, s.scale[0]), kv = div(zc, s.scale[1]);
    o.a1 = mul(ku, o.G00);
    o.a2 = mul(ku, o.G01);
    o.b1 = mul(kv, o.G10);
    o.b2 = mul(kv, o.G11);
    o.g1 = neg(fma(o.u[2], o.G00, mul(o.v[2], o.G10)));
    o.g2 = neg(fma(o.u[2], o.G01, mul(o.v[2], o.G11)));

    // x * 0 is 0 for a number and NaN for NaN and infinities.
    F probe = mul(s.opacity, zero);
    for (int k = 0; k < 3; ++k) probe = fma(s.mean[k], zero, fma(s.color[k], zero, probe));
    for (int k = 0; k < 2; ++k) probe = fma(s.scale[k], zero, probe);
    probe = fma(norm2, zero, probe);
    const M finite = eq(probe, zero);
    const M proper = both(lt(zero, s.scale[0]), both(lt(zero, s.scale[1]), lt(splat(1e-24f), norm2)));
    const F limit = mul(splat(kEdgeOnCosine * kEdgeOnCosine), dot3(o.c, o.c));
    const F sizes = fma(o.a1, zero, fma(o.a2, zero, fma(o.b1, zero, mul(o.b2, zero))));
    const M solid = both(lt(limit, mul(o.facing, o.facing)), eq(fma(o.g1, zero, fma(o.g2, zero, sizes)), zero));
    const M all = le(zero, zero);
    o.bad = andnot(all, both(finite, proper));
    o.edge_on = andnot(all, solid);
    return o;
}

}  // namespace mass::MASS_ISA
