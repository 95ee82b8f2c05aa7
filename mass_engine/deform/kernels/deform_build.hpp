#pragma once

// Included by each isa_*.cpp after it has defined MASS_ISA and MASS_WIDTH: the whole kernel, once.
#include "posing.hpp"
#include "tables.hpp"

#define MASS_TEXT_(x) #x
#define MASS_TEXT(x) MASS_TEXT_(x)

namespace mass::MASS_ISA {

extern const DeformTable deform_table = {MASS_TEXT(MASS_ISA), decode, decode_backward, deform, deform_backward, pose_surfels};

}  // namespace mass::MASS_ISA
