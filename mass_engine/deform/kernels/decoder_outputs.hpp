// From the decoder's nine outputs to residuals, and back.
#pragma once

#include "decoder_types.hpp"
#include "vectors.hpp"

namespace mass::MASS_ISA {

MASS_INLINE F relu(F x) { return max(x, splat(0.0f)); }

inline constexpr float kLog2 = 0.69314718f;

MASS_INLINE F tanh_of(F x) {
    const F q = exp_neg(mul(splat(-2.0f), abs(x))), one = splat(1.0f);
    const F t = div(sub(one, q), add(one, q));
    return select(lt(x, splat(0.0f)), neg(t), t);
}

struct Outputs {
    F offset[3], log_scale[2], rotation[3], mask_logit;
};

// `output(k)` is the head's k-th.
template <class Output>
MASS_INLINE Outputs residuals_of(float offset_unit, float rotation_unit, Output output) {
    Outputs o;
    for (int k = 0; k < 3; ++k) o.offset[k] = mul(splat(offset_unit), output(k));
    for (int k = 0; k < 2; ++k) o.log_scale[k] = mul(splat(kLog2), tanh_of(output(3 + k)));
    for (int k = 0; k < 3; ++k) o.rotation[k] = mul(splat(rotation_unit), output(5 + k));
    o.mask_logit = output(8);
    return o;
}

// `out`: gradients of the residuals, then of the head's outputs; `log_scale` are the residuals, which know their slope.
MASS_INLINE void differentiate_outputs(float offset_unit, float rotation_unit, const F* log_scale, F* out) {
    for (int k = 0; k < 3; ++k) out[k] = mul(splat(offset_unit), out[k]);
    for (int k = 0; k < 2; ++k) {
        const F slope = fnma(mul(log_scale[k], log_scale[k]), splat(1.0f / kLog2), splat(kLog2));
        out[3 + k] = mul(slope, out[3 + k]);
    }
    for (int k = 0; k < 3; ++k) out[5 + k] = mul(splat(rotation_unit), out[5 + k]);
}

}  // namespace mass::MASS_ISA
