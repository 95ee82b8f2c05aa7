// The kernels of each instruction set. Each lives in one translation unit compiled with its own flags.
#pragma once

#include "posing_types.hpp"
#include "residual_types.hpp"

namespace mass {

struct DeformTable {
    const char* name;
    void (*decode)(const DecoderData&, const ResidualRows&, int begin, int end);
    void (*decode_backward)(const DecoderData&, const ResidualRowGradients&, float* d_share, const DecoderSums&, int begin,
                            int end);
    void (*deform)(const ResidualData&, float* means, float* tangents, float* normals, int begin, int end);
    void (*deform_backward)(const ResidualData&, const ResidualGradient&, int begin, int end);
    void (*pose_surfels)(const PosingData&, const PosedData&, int begin, int end);
};

#if defined(MASS_BUILD_X86)
namespace avx512 {
extern const DeformTable deform_table;
}
namespace avx2 {
extern const DeformTable deform_table;
}
#endif
namespace portable {
extern const DeformTable deform_table;
}
namespace scalar {
extern const DeformTable deform_table;
}

}  // namespace mass
