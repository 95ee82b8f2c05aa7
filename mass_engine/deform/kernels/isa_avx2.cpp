// The kernels for avx2: see raster/kernels/isa_avx2.cpp.
#define MASS_ISA avx2
#define MASS_WIDTH 8
#include "deform_build.hpp"
