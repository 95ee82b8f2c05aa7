// The kernel for AVX-512 (F, VL, DQ, BW).
#define MASS_ISA avx512
#define MASS_WIDTH 16
#include "build.hpp"
