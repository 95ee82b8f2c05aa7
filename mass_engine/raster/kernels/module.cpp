// Python bindings. Arrays are DLPack views of contiguous float32 CPU tensors; cpu.py has checked their shapes.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <optional>

#include "renderer.hpp"

namespace nb = nanobind;

namespace {

using In = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;
using Out = nb::ndarray<float, nb::c_contig, nb::device::cpu>;
using OptionalIn = std::optional<In>;
using OptionalOut = std::optional<Out>;

const float* data(const OptionalIn& x) { return x ? x->data() : nullptr; }
float* data(const OptionalOut& x) { return x ? x->data() : nullptr; }

// colors [N,3] are colours, [N,K,3] harmonics.
mass::SurfelData surfels(const In& means, const In& tangents, const In& opacities, const In& colors) {
    const bool plain = colors.ndim() == 2;
    return {means.data(), tangents.data(), opacities.data(), plain ? colors.data() : nullptr, plain ? nullptr : colors.data(),
            static_cast<int>(opacities.size()), plain ? 0 : static_cast<int>(colors.shape(1))};
}

nb::dict as_dict(const mass::FrameProfile& p) {
    nb::dict d;
    d["project"] = p.project;
    d["list"] = p.list;
    d["blend"] = p.blend;
    d["sort"] = p.sort;
    d["gather_weights"] = p.gather_weights;
    d["blend_backward"] = p.blend_backward;
    d["project_backward"] = p.project_backward;
    d["blocks"] = static_cast<double>(p.blocks);
    d["blocks_backward"] = static_cast<double>(p.blocks_backward);
    return d;
}

// Returns its buffers to the renderer when Python lets go of it.
class Frame {
public:
    Frame(std::shared_ptr<mass::Renderer> renderer, std::unique_ptr<mass::FrameBuffers> buffers)
        : renderer_(std::move(renderer)), buffers_(std::move(buffers)) {}
    Frame(Frame&&) = default;
    ~Frame() {
        if (buffers_) renderer_->recycle(std::move(buffers_));
    }
    mass::FrameBuffers& buffers() { return *buffers_; }

private:
    std::shared_ptr<mass::Renderer> renderer_;
    std::unique_ptr<mass::FrameBuffers> buffers_;
};

class Handle {
public:
    explicit Handle(const std::string& instruction_set) : renderer_(std::make_shared<mass::Renderer>(instruction_set)) {}

    std::string instruction_set() const { return renderer_->instruction_set(); }

    // camera: A (9), t (3), K2 (4), k (2), near, distortion scale
    Frame forward(const std::vector<float>& camera, int width, int height, bool cull_backfaces, int bounds, bool center_depth,
                  unsigned without, const In& means, const In& tangents, const In& opacities, const In& colors, Out& rgb,
                  Out& alpha, Out& depth, OptionalOut median, OptionalOut normal, OptionalOut distortion, OptionalOut weights,
                  bool differentiable, int threads) {
        if (camera.size() != 20) throw std::invalid_argument("camera needs 20 numbers");
        if (bounds < 0 || bounds > 2) throw std::invalid_argument("bounds is 0, 1 or 2");
        mass::CameraData c{};
        for (std::size_t k = 0; k < 9; ++k) c.A[k] = camera[k];
        for (std::size_t k = 0; k < 3; ++k) c.t[k] = camera[9 + k];
        for (std::size_t k = 0; k < 4; ++k) c.K2[k] = camera[12 + k];
        for (std::size_t k = 0; k < 2; ++k) c.k[k] = camera[16 + k];
        for (std::size_t k = 0; k < 3; ++k) c.center[k] = -(c.A[k] * c.t[0] + c.A[3 + k] * c.t[1] + c.A[6 + k] * c.t[2]);
        c.bounds = static_cast<mass::Bounds>(bounds);
        c.center_depth = center_depth;
        c.without = without;
        c.near_z = camera[18];
        c.inverse_near = 1.0f / c.near_z;
        c.distortion_scale = camera[19];
        c.width = width;
        c.height = height;
        c.tiles_x = (width + mass::kTile - 1) / mass::kTile;
        c.tiles_y = (height + mass::kTile - 1) / mass::kTile;
        c.cull_backfaces = cull_backfaces;
        const mass::SurfelData s = surfels(means, tangents, opacities, colors);
        const mass::ImageData images{rgb.data(), alpha.data(), depth.data(), data(median), data(normal), data(distortion)};
        float* w = data(weights);
        nb::gil_scoped_release release;
        return Frame(renderer_, renderer_->forward(c, s, images, w, differentiable, threads));
    }

    void backward(Frame& frame, const In& means, const In& tangents, const In& opacities, const In& colors, const In& alpha,
                  const In& depth, OptionalIn d_rgb, OptionalIn d_alpha, OptionalIn d_depth, OptionalIn d_median,
                  OptionalIn d_normal, OptionalIn d_distortion, Out& d_means, Out& d_tangents, Out& d_opacities, Out& d_colors,
                  Out& d_camera, int threads) {
        const mass::SurfelData s = surfels(means, tangents, opacities, colors);
        // The backward pass only reads alpha and depth.
        const mass::ImageData images{nullptr, const_cast<float*>(alpha.data()), const_cast<float*>(depth.data()),
                                     nullptr, nullptr, nullptr};
        const mass::ImageGradient gradient{data(d_rgb), data(d_alpha), data(d_depth), data(d_median), data(d_normal), data(d_distortion)};
        const mass::SurfelGradient out{d_means.data(), d_tangents.data(), d_opacities.data(), s.colors ? d_colors.data() : nullptr,
                                       s.colors ? nullptr : d_colors.data()};
        float* camera_gradient = d_camera.data();
        nb::gil_scoped_release release;
        renderer_->backward(frame.buffers(), s, images, gradient, out, camera_gradient, threads);
    }

private:
    std::shared_ptr<mass::Renderer> renderer_;
};

}  // namespace

NB_MODULE(_kernels, m) {
    m.doc() = "2-D Gaussian surfel rasteriser: compiled kernels (see mass_engine.raster.cpu).";
    // The shared renderer and graphs held by globals live until the process ends: not a leak worth a report.
    nb::set_leak_warnings(false);

    nb::dict constants;
    constants["alpha_max"] = mass::kAlphaMax;
    constants["alpha_cut"] = mass::kAlphaCut;
    constants["transmittance_stop"] = mass::kTransmittanceStop;
    constants["low_pass"] = mass::kLowPass;
    constants["median_transmittance"] = mass::kMedianTransmittance;
    constants["edge_on_cosine"] = mass::kEdgeOnCosine;
    constants["least_sine2"] = mass::kLeastSine2;
    constants["least_area2"] = mass::kLeastArea2;
    m.attr("CONSTANTS") = constants;
    m.def("instruction_sets", &mass::Renderer::available, "Instruction sets this machine can run, best first.");

    nb::exception<mass::TooManyPairs>(m, "TooManyPairsError", PyExc_RuntimeError);

    nb::class_<Frame>(m, "Frame", "What one forward pass keeps for its backward pass.")
        .def_prop_ro("dropped", [](Frame& f) { return f.buffers().dropped; })
        .def_prop_ro("pairs", [](Frame& f) { return f.buffers().binning.pair_count(); })
        .def_prop_ro("profile", [](Frame& f) { return as_dict(f.buffers().profile); })
        .def_prop_ro("bytes", [](Frame& f) { return f.buffers().bytes(); });

    nb::class_<Handle>(m, "Renderer", "A kernel, its threads and the buffers it reuses. Calls may come from any thread.")
        .def(nb::init<const std::string&>(), nb::arg("instruction_set") = "auto")
        .def_prop_ro("instruction_set", &Handle::instruction_set)
        .def("forward", &Handle::forward, nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(),
             nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg().none(), nb::arg().none(),
             nb::arg().none(), nb::arg().none(), nb::arg(), nb::arg())
        .def("backward", &Handle::backward, nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(),
             nb::arg().none(), nb::arg().none(), nb::arg().none(), nb::arg().none(), nb::arg().none(), nb::arg().none(),
             nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg());
}
