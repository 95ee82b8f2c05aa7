// What residuals do to surfels, and its gradient: residuals.py says it in plain torch.
#pragma once

#include "residual_types.hpp"
#include "vectors.hpp"

namespace mass::MASS_ISA {

struct Change {
    V3 offset;                      // along (tangent, bitangent, normal)
    F first_scale, second_scale;    // factors
    V3 rotation;                    // about the same axes
};

// The surfel's own frame (t, b, n), and its tangents in it: first = length t, second = along t + across b.
struct Frame {
    V3 t, b, n;
    F length, along, across;
};

MASS_INLINE Frame frame_of(const V3& first, const V3& second, const V3& normal) {
    Frame f;
    f.length = safe_length(first);
    f.t = mul(div(splat(1.0f), f.length), first);
    f.n = normal;
    f.b = cross(normal, f.t);
    f.along = dot(second, f.t);
    f.across = dot(second, f.b);
    return f;
}

// What a rotation adds to each axis of the frame: add_i = sum_j k D[i][j] e_j, a = rotation / 2, k = 2 / (1 + a.a).
struct Turn {
    F x, y, z, k;
    F D[3][3];
    V3 add_t, add_b, add_n;
};

MASS_INLINE Turn turn_of(const V3& rotation, const Frame& f) {
    Turn r;
    const F half = splat(0.5f);
    const F x = mul(half, rotation.x), y = mul(half, rotation.y), z = mul(half, rotation.z);
    const F xx = mul(x, x), yy = mul(y, y), zz = mul(z, z), xy = mul(x, y), xz = mul(x, z), yz = mul(y, z);
    r.x = x, r.y = y, r.z = z;
    r.k = div(splat(2.0f), add(splat(1.0f), add(xx, add(yy, zz))));
    r.D[0][0] = neg(add(yy, zz)), r.D[0][1] = add(xy, z), r.D[0][2] = sub(xz, y);
    r.D[1][0] = sub(xy, z), r.D[1][1] = neg(add(xx, zz)), r.D[1][2] = add(yz, x);
    r.D[2][0] = add(xz, y), r.D[2][1] = sub(yz, x), r.D[2][2] = neg(add(xx, yy));
    const auto combine = [&](const F* c) { return mul(r.k, fma(c[0], f.t, fma(c[1], f.b, mul(c[2], f.n)))); };
    r.add_t = combine(r.D[0]);
    r.add_b = combine(r.D[1]);
    r.add_n = combine(r.D[2]);
    return r;
}

MASS_INLINE void apply(const Change& c, V3& mean, V3& first, V3& second, V3& normal) {
    const Frame f = frame_of(first, second, normal);
    const Turn r = turn_of(c.rotation, f);
    mean = add(mean, fma(c.offset.x, f.t, fma(c.offset.y, f.b, mul(c.offset.z, f.n))));
    first = mul(c.first_scale, fma(f.length, r.add_t, first));
    second = mul(c.second_scale, fma(f.along, r.add_t, fma(f.across, r.add_b, second)));
    normal = add(normal, r.add_n);
}

template <int width>
MASS_INLINE void load_vectors(const float* in, int row, int count, V3* out) {
    F values[3 * width];
    load_rows<3 * width>(in + static_cast<long>(row) * 3 * width, count, values);
    for (int k = 0; k < width; ++k) out[k] = {values[3 * k], values[3 * k + 1], values[3 * k + 2]};
}

template <int width>
MASS_INLINE void store_vectors(const V3* values, int row, int count, float* out) {
    F flat[3 * width];
    for (int k = 0; k < width; ++k) flat[3 * k] = values[k].x, flat[3 * k + 1] = values[k].y, flat[3 * k + 2] = values[k].z;
    interleave<3 * width>(flat, count, out + static_cast<long>(row) * 3 * width);
}

MASS_INLINE Change load_change(const ResidualData& d, int row, int count) {
    Change c;
    F log_scale[2];
    load_vectors<1>(d.offset, row, count, &c.offset);
    load_vectors<1>(d.rotation, row, count, &c.rotation);
    load_rows<2>(d.log_scale + static_cast<long>(row) * 2, count, log_scale);
    c.first_scale = exp_any(log_scale[0]);
    c.second_scale = exp_any(log_scale[1]);
    return c;
}

// Rows [begin, end) of flattened batches.
MASS_ENTRY void deform(const ResidualData& d, float* means, float* tangents, float* normals, int begin, int end) {
    for (int row = begin; row < end; row += kLanes) {
        const int count = end - row < kLanes ? end - row : kLanes;
        V3 mean, pair[2], normal;
        load_vectors<1>(d.means, row, count, &mean);
        load_vectors<2>(d.tangents, row, count, pair);
        load_vectors<1>(d.normals, row, count, &normal);
        apply(load_change(d, row, count), mean, pair[0], pair[1], normal);
        store_vectors<1>(&mean, row, count, means);
        store_vectors<2>(pair, row, count, tangents);
        store_vectors<1>(&normal, row, count, normals);
    }
}

// The gradient of the means passes unchanged; those of the rest of rows [begin, end).
MASS_ENTRY void deform_backward(const ResidualData& d, const ResidualGradient& g, int begin, int end) {
    for (int row = begin; row < end; row += kLanes) {
        const int count = end - row < kLanes ? end - row : kLanes;
        V3 pair[2], normal, Gm, G[2], Gn;
        load_vectors<2>(d.tangents, row, count, pair);
        load_vectors<1>(d.normals, row, count, &normal);
        load_vectors<1>(g.means, row, count, &Gm);
        load_vectors<2>(g.tangents, row, count, G);
        load_vectors<1>(g.normals, row, count, &Gn);
        const Change c = load_change(d, row, count);
        const Frame f = frame_of(pair[0], pair[1], normal);
        const Turn r = turn_of(c.rotation, f);

        const V3 H0 = mul(c.first_scale, G[0]), H1 = mul(c.second_scale, G[1]);
        const F d_log_scale[2] = {dot(H0, fma(f.length, r.add_t, pair[0])),
                                  dot(H1, fma(f.along, r.add_t, fma(f.across, r.add_b, pair[1])))};
        const V3 d_add[3] = {fma(f.length, H0, mul(f.along, H1)), mul(f.across, H1), Gn};
        const V3 axes[3] = {f.t, f.b, f.n};
        const F offset[3] = {c.offset.x, c.offset.y, c.offset.z};

        F gD[3][3], gk = splat(0.0f);
        V3 d_axis[3];
        for (int j = 0; j < 3; ++j) {
            V3 sum = mul(r.D[0][j], d_add[0]);
            for (int i = 0; i < 3; ++i) {
                const F product = dot(d_add[i], axes[j]);
                gk = fma(product, r.D[i][j], gk);
                gD[i][j] = mul(r.k, product);
                if (i > 0) sum = fma(r.D[i][j], d_add[i], sum);
            }
            d_axis[j] = fma(r.k, sum, mul(offset[j], Gm));
        }
        const F two = splat(2.0f), x = r.x, y = r.y, z = r.z, via_k = mul(mul(r.k, r.k), gk);
        const auto rotation = [&](F at, F pairs, F alone, F squares) {  // half of d a, and what came through k
            return mul(splat(0.5f), sub(add(pairs, alone), mul(at, fma(two, squares, via_k))));
        };
        const V3 d_rotation = {
            rotation(x, fma(y, add(gD[0][1], gD[1][0]), mul(z, add(gD[0][2], gD[2][0]))), sub(gD[1][2], gD[2][1]), add(gD[1][1], gD[2][2])),
            rotation(y, fma(x, add(gD[0][1], gD[1][0]), mul(z, add(gD[1][2], gD[2][1]))), sub(gD[2][0], gD[0][2]), add(gD[0][0], gD[2][2])),
            rotation(z, fma(x, add(gD[0][2], gD[2][0]), mul(y, add(gD[1][2], gD[2][1]))), sub(gD[0][1], gD[1][0]), add(gD[0][0], gD[1][1]))};
        const V3 d_offset = {dot(Gm, f.t), dot(Gm, f.b), dot(Gm, f.n)};

        const F d_along = dot(H1, r.add_t), d_across = dot(H1, r.add_b);
        const V3 d_b = fma(d_across, pair[1], d_axis[1]);
        const V3 d_t = add(fma(d_along, pair[1], d_axis[0]), cross(d_b, f.n));
        const F inverse = div(splat(1.0f), f.length);
        const F d_length = fnma(mul(dot(d_t, f.t), inverse), splat(1.0f), dot(H0, r.add_t));
        const V3 d_pair[2] = {add(H0, fma(inverse, d_t, mul(d_length, f.t))), fma(d_along, f.t, fma(d_across, f.b, H1))};
        const V3 d_normal = add(Gn, add(d_axis[2], cross(f.t, d_b)));
        store_vectors<2>(d_pair, row, count, g.d_tangents);
        store_vectors<1>(&d_normal, row, count, g.d_normals);
        store_vectors<1>(&d_offset, row, count, g.d_offset);
        interleave<2>(d_log_scale, count, g.d_log_scale + static_cast<long>(row) * 2);
        store_vectors<1>(&d_rotation, row, count, g.d_rotation);
    }
}

}  // namespace mass::MASS_ISA
