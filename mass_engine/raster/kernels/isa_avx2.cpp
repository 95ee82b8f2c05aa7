// The kernel for AVX2 and FMA.
#define MASS_ISA avx2
#define MASS_WIDTH 8
#include "build.hpp"
