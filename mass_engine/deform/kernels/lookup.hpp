// Sixteen lanes, each reading a place of its own.
#pragma once

#include "simd.hpp"

namespace mass::MASS_ISA {

// p[index[lane]]
MASS_INLINE F gather_at(const float* p, const int32_t* index) {
#if MASS_WIDTH == 16
    return _mm512_i32gather_ps(_mm512_loadu_si512(index), p, 4);
#else
    float x[kLanes];
    for (int l = 0; l < kLanes; ++l) x[l] = p[index[l]];
    return load(x);
#endif
}

// table[index[lane]] of sixteen entries
MASS_INLINE F pick(const float* table, const int32_t* index) {
#if MASS_WIDTH == 16
    return _mm512_permutexvar_ps(_mm512_loadu_si512(index), load(table));
#else
    return gather_at(table, index);
#endif
}

}  // namespace mass::MASS_ISA
