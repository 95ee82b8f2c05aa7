// Python bindings of the GPU kernels. Arrays are DLPack views of contiguous float32 tensors on the GPU (on the CPU in the
// emulation); cuda.py has checked their shapes. Nothing waits for the GPU.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>

#include <optional>

#include "cuda_frame.hpp"
#include "device_error.hpp"
#if defined(MASS_EMULATED)
#include "emulator.hpp"
#endif

namespace nb = nanobind;

namespace {

#if defined(MASS_EMULATED)
using Place = nb::device::cpu;
#else
using Place = nb::device::cuda;
#endif
using In = nb::ndarray<const float, nb::c_contig, Place>;
using Out = nb::ndarray<float, nb::c_contig, Place>;
using Bytes = nb::ndarray<uint8_t, nb::c_contig, Place>;
using Counters = nb::ndarray<int32_t, nb::c_contig, Place>;
using OptionalIn = std::optional<In>;
using OptionalOut = std::optional<Out>;

const float* data(const OptionalIn& x) { return x ? x->data() : nullptr; }
float* data(const OptionalOut& x) { return x ? x->data() : nullptr; }

// All of a frame that is the same at every step of a captured graph: sizes and settings.
class Plan {
public:
    Plan(int surfels, int width, int height, int capacity, bool extra, bool differentiable, float near_z, float distortion_scale,
         bool cull_backfaces, int bounds, bool center_depth)
        : shape_{surfels, width, height, capacity, extra, differentiable, 0} {
        if (surfels < 0 || capacity < 0 || width <= 0 || height <= 0) throw std::invalid_argument("sizes are negative");
        shape_.scratch_bytes = mass::gpu::scratch_bytes(mass::gpu::most_items(shape_));
        if (bounds < 0 || bounds > 2) throw std::invalid_argument("bounds is 0, 1 or 2");
        camera_.near_z = near_z;
        camera_.inverse_near = 1.0f / near_z;
        camera_.width = width;
        camera_.height = height;
        camera_.tiles_x = (width + mass::kTile - 1) / mass::kTile;
        camera_.tiles_y = (height + mass::kTile - 1) / mass::kTile;
        camera_.cull_backfaces = cull_backfaces;
        camera_.bounds = static_cast<mass::Bounds>(bounds);
        camera_.center_depth = center_depth;
        camera_.distortion_scale = distortion_scale;
    }

    std::size_t bytes() const { return mass::gpu::frame_bytes(shape_); }

    void forward(uintptr_t stream, Bytes& memory, Counters& counters, const In& means, const In& tangents, const In& opacities,
                 const In& colors, const In& pose, const In& K, Out& rgb, Out& alpha, Out& depth, OptionalOut median, OptionalOut normal,
                 OptionalOut distortion, OptionalOut weights) const {
        const mass::ImageData images{rgb.data(), alpha.data(), depth.data(), data(median), data(normal), data(distortion)};
        const mass::gpu::Call call = make_call(stream, memory, means, tangents, opacities, colors, pose, K);
        mass::gpu::forward(call, images, data(weights), counters.data(), memory.device_id());
    }

    void backward(uintptr_t stream, Bytes& memory, const In& means, const In& tangents, const In& opacities, const In& colors,
                  const In& pose, const In& K, const In& alpha, const In& depth, OptionalIn d_rgb, OptionalIn d_alpha, OptionalIn d_depth,
                  OptionalIn d_median, OptionalIn d_normal, OptionalIn d_distortion, Out& d_means, Out& d_tangents, Out& d_opacities,
                  Out& d_colors, Out& d_pose, Out& d_K) const {
        // The backward pass only reads alpha and depth.
        const mass::ImageData images{nullptr, const_cast<float*>(alpha.data()), const_cast<float*>(depth.data()),
                                     nullptr, nullptr, nullptr};
        const mass::ImageGradient gradient{data(d_rgb), data(d_alpha), data(d_depth), data(d_median), data(d_normal), data(d_distortion)};
        const mass::gpu::Call call = make_call(stream, memory, means, tangents, opacities, colors, pose, K);
        const bool plain = call.surfels.colors != nullptr;
        const mass::SurfelGradient out{d_means.data(), d_tangents.data(), d_opacities.data(), plain ? d_colors.data() : nullptr,
                                       plain ? nullptr : d_colors.data()};
        mass::gpu::backward(call, images, gradient, out, d_pose.data(), d_K.data(), memory.device_id());
    }

private:
    mass::gpu::Call make_call(uintptr_t stream, Bytes& memory, const In& means, const In& tangents, const In& opacities,
                              const In& colors, const In& pose, const In& K) const {
        if (memory.size() < bytes()) throw std::invalid_argument("the frame's memory is too small");
        if (opacities.size() != static_cast<std::size_t>(shape_.surfels)) throw std::invalid_argument("another number of surfels");
        const bool plain = colors.ndim() == 2;
        const mass::SurfelData surfels{means.data(), tangents.data(), opacities.data(), plain ? colors.data() : nullptr,
                                       plain ? nullptr : colors.data(), shape_.surfels, plain ? 0 : static_cast<int>(colors.shape(1))};
        return {camera_, pose.data(), K.data(), surfels, shape_, mass::gpu::lay_out(shape_, memory.data()),
                reinterpret_cast<void*>(stream)};
    }

    mass::CameraData camera_{};
    mass::gpu::Shape shape_;
};

}  // namespace

NB_MODULE(_cuda_kernels, m) {
    m.doc() = "2-D Gaussian surfel rasteriser: GPU kernels (see mass_engine.raster.cuda).";
    nb::set_leak_warnings(false);
    nb::exception<mass::DeviceError>(m, "DeviceError", PyExc_RuntimeError);
    m.def("problem", &mass::gpu::problem, "Why no kernel can run here; empty when one can.");
#if defined(MASS_EMULATED)
    m.def("reverse_threads", [](bool reverse) { mass::emulator::machine().reverse = reverse; }, "The order in which threads run.");
#endif
    nb::class_<Plan>(m, "Plan", "Sizes and settings of a frame; the device memory it takes, and its passes.")
        .def(nb::init<int, int, int, int, bool, bool, float, float, bool, int, bool>())
        .def_prop_ro("bytes", &Plan::bytes)
        .def("forward", &Plan::forward, nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(),
             nb::arg(), nb::arg(), nb::arg(), nb::arg().none(), nb::arg().none(), nb::arg().none(), nb::arg().none())
        .def("backward", &Plan::backward, nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(),
             nb::arg(), nb::arg().none(), nb::arg().none(), nb::arg().none(), nb::arg().none(), nb::arg().none(), nb::arg().none(),
             nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg());
}
