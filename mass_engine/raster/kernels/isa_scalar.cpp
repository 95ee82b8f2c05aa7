// The kernel for one lane and no vectorisation: the yardstick for the others.
#define MASS_ISA scalar
#define MASS_WIDTH 1
#include "build.hpp"
