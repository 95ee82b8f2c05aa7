// The kernels for avx512: see raster/kernels/isa_avx512.cpp.
#define MASS_ISA avx512
#define MASS_WIDTH 16
#include "deform_build.hpp"
