// The kernels for scalar: see raster/kernels/isa_scalar.cpp.
#define MASS_ISA scalar
#define MASS_WIDTH 1
#include "deform_build.hpp"
