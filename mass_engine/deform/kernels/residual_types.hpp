// Plain data of applying residuals. No functions: see raster/kernels/types.hpp.
#pragma once

namespace mass {

// Flattened rows of surfels: means [R,3], tangents [R,2,3], normals [R,3], and their residuals.
struct ResidualData {
    const float *means, *tangents, *normals;
    const float *offset, *log_scale, *rotation;  // [R,3], [R,2], [R,3]
};

struct ResidualGradient {
    const float *means, *tangents, *normals;  // of the deformed surfels
    float *d_tangents, *d_normals, *d_offset, *d_log_scale, *d_rotation;
};

}  // namespace mass
