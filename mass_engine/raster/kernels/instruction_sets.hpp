// The kernel's builds. Each lives in one translation unit compiled with its own flags.
#pragma once

#include "types.hpp"

namespace mass {

#if defined(MASS_BUILD_X86)
namespace avx512 {
extern const KernelTable table;
}
namespace avx2 {
extern const KernelTable table;
}
#endif
namespace portable {
extern const KernelTable table;
}
namespace scalar {
extern const KernelTable table;
}

}  // namespace mass
