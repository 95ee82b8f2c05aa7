#pragma once

#include <stdexcept>

namespace mass {

// What the GPU's driver reported.
struct DeviceError : std::runtime_error {
    using std::runtime_error::runtime_error;
};

}  // namespace mass
