// What the deformation's residuals do to surfels, and the gradient of it: a thread per surfel.
#define MASS_ISA device
#define MASS_WIDTH 0
#include "device.hpp"

#include "passes.hpp"
#include "residuals.hpp"

namespace mass::device {

inline constexpr int kRowThreads = 128;

MASS_KERNEL(kRowThreads) deform_rows(ResidualData d, float* means, float* tangents, float* normals, int rows) {
    const int row = block_index() * kRowThreads + thread_index();
    if (row < rows) deform(d, means, tangents, normals, row, row + 1);
}

MASS_KERNEL(kRowThreads) deform_rows_backward(ResidualData d, ResidualGradient g, int rows) {
    const int row = block_index() * kRowThreads + thread_index();
    if (row < rows) deform_backward(d, g, row, row + 1);
}

}  // namespace mass::device

namespace mass::gpu {

void deform(const ResidualData& d, float* means, float* tangents, float* normals, int rows, int device, void* stream) {
    const DeviceGuard guard(device);
    const int blocks = (rows + device::kRowThreads - 1) / device::kRowThreads;
    launch(device::deform_rows, blocks, device::kRowThreads, static_cast<Stream>(stream), d, means, tangents, normals, rows);
}

void deform_backward(const ResidualData& d, const ResidualGradient& g, int rows, int device, void* stream) {
    const DeviceGuard guard(device);
    const int blocks = (rows + device::kRowThreads - 1) / device::kRowThreads;
    launch(device::deform_rows_backward, blocks, device::kRowThreads, static_cast<Stream>(stream), d, g, rows);
}

}  // namespace mass::gpu
