// The kernel for four lanes of whatever the target has (SSE2, NEON).
#define MASS_ISA portable
#define MASS_WIDTH 4
#include "build.hpp"
