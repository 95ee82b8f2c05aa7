// The kernels for portable: see raster/kernels/isa_portable.cpp.
#define MASS_ISA portable
#define MASS_WIDTH 4
#include "deform_build.hpp"
