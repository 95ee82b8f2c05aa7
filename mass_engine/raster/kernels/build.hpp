#pragma once

// Included by each isa_*.cpp after it has defined MASS_ISA and MASS_WIDTH: the whole kernel, once.
#include "blend.hpp"
#include "blend_backward.hpp"
#include "instruction_sets.hpp"
#include "project.hpp"
#include "project_backward.hpp"

#define MASS_TEXT_(x) #x
#define MASS_TEXT(x) MASS_TEXT_(x)

namespace mass::MASS_ISA {

extern const KernelTable table = {MASS_TEXT(MASS_ISA), project, blend, blend_backward, project_backward};

}  // namespace mass::MASS_ISA
