// Python bindings. Arrays are DLPack views of contiguous tensors on the GPU (on the CPU in the emulation); the callers have
// checked their shapes. Nothing waits for the GPU.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>

#include <optional>

#include "device_error.hpp"
#include "passes.hpp"
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
using Index = nb::ndarray<const int32_t, nb::c_contig, Place>;

void* pointer(uintptr_t stream) { return reinterpret_cast<void*>(stream); }

mass::gpu::Pictures pictures(const In& seen, const In& wanted, const In& inside) {
    const int height = static_cast<int>(inside.shape(0)), width = static_cast<int>(inside.shape(1));
    return {seen.data(), wanted.data(), inside.data(), height, width};
}

void product(uintptr_t stream, const Index& begins, const Index& columns, const In& values, const In& dense, bool few, Out& out) {
    const mass::gpu::Rows rows{begins.data(), columns.data(), values.data(), static_cast<int>(begins.size()) - 1};
    mass::gpu::product(rows, dense.data(), static_cast<int>(dense.shape(1)), few, out.data(), out.device_id(), pointer(stream));
}

void ssim(uintptr_t stream, const In& seen, const In& wanted, const In& inside, Out& sums, std::optional<Out> slopes) {
    mass::gpu::ssim(pictures(seen, wanted, inside), sums.data(), slopes ? slopes->data() : nullptr, sums.device_id(), pointer(stream));
}

void ssim_backward(uintptr_t stream, const In& seen, const In& wanted, const In& inside, const In& slopes, const In& scale, Out& d_seen) {
    mass::gpu::ssim_backward(pictures(seen, wanted, inside), slopes.data(), scale.data(), d_seen.data(), d_seen.device_id(), pointer(stream));
}

mass::DecoderData decoder(const In& share, const In& pose, const In& second, const In& second_bias, const In& head, const In& head_bias,
                         float offset_unit, float rotation_unit) {
    mass::DecoderData d{};
    d.share = share.data();
    d.pose = pose.data();
    d.second = second.data();
    d.second_bias = second_bias.data();
    d.head = head.data();
    d.head_bias = head_bias.data();
    d.offset_unit = offset_unit;
    d.rotation_unit = rotation_unit;
    d.count = static_cast<int>(share.shape(0));
    d.hidden = static_cast<int>(share.shape(1));
    d.batch = static_cast<int>(pose.shape(0));
    return d;
}

void decode(uintptr_t stream, const In& share, const In& pose, const In& second, const In& second_bias, const In& head,
            const In& head_bias, float offset_unit, float rotation_unit, Out& offset, Out& log_scale, Out& rotation, Out& mask_logit) {
    const mass::DecoderData d = decoder(share, pose, second, second_bias, head, head_bias, offset_unit, rotation_unit);
    mass::gpu::decode(d, {offset.data(), log_scale.data(), rotation.data(), mask_logit.data()}, share.device_id(), pointer(stream));
}

void decode_backward(uintptr_t stream, const In& share, const In& pose, const In& second, const In& second_bias, const In& head,
                     const In& head_bias, float offset_unit, float rotation_unit, const In& d_offset, const In& d_log_scale,
                     const In& d_rotation, const In& d_mask_logit, const In& log_scale, Out& d_share, Out& partial, Out& sums) {
    const mass::DecoderData d = decoder(share, pose, second, second_bias, head, head_bias, offset_unit, rotation_unit);
    const mass::ResidualRowGradients g{d_offset.data(), d_log_scale.data(), d_rotation.data(), d_mask_logit.data(), log_scale.data()};
    mass::gpu::decode_backward(d, g, d_share.data(), partial.data(), sums.data(), share.device_id(), pointer(stream));
}

void deform(uintptr_t stream, const In& means, const In& tangents, const In& normals, const In& offset, const In& log_scale,
            const In& rotation, Out& means_out, Out& tangents_out, Out& normals_out) {
    const mass::ResidualData d{means.data(), tangents.data(), normals.data(), offset.data(), log_scale.data(), rotation.data()};
    mass::gpu::deform(d, means_out.data(), tangents_out.data(), normals_out.data(), static_cast<int>(means.size() / 3), means.device_id(),
                      pointer(stream));
}

void deform_backward(uintptr_t stream, const In& tangents, const In& normals, const In& offset, const In& log_scale, const In& rotation,
                     const In& d_means_in, const In& d_tangents_in, const In& d_normals_in, Out& d_tangents, Out& d_normals, Out& d_offset,
                     Out& d_log_scale, Out& d_rotation) {
    const mass::ResidualData d{nullptr, tangents.data(), normals.data(), offset.data(), log_scale.data(), rotation.data()};
    const mass::ResidualGradient g{d_means_in.data(), d_tangents_in.data(), d_normals_in.data(), d_tangents.data(),
                                   d_normals.data(), d_offset.data(), d_log_scale.data(), d_rotation.data()};
    mass::gpu::deform_backward(d, g, static_cast<int>(normals.size() / 3), normals.device_id(), pointer(stream));
}

}  // namespace

NB_MODULE(_kernels, m) {
    m.doc() = "What a fit does beside rasterising, on the GPU (see mass_engine.gpu).";
    nb::set_leak_warnings(false);
    nb::exception<mass::DeviceError>(m, "DeviceError", PyExc_RuntimeError);
    m.def("ssim_blocks", &mass::gpu::ssim_blocks);
    m.def("product", &product);
    m.def("ssim", &ssim, nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg().none());
    m.def("ssim_backward", &ssim_backward);
    m.def("decoder_blocks", &mass::gpu::decoder_blocks);
    m.def("decoder_sums", &mass::gpu::decoder_sums);
    m.def("decode", &decode);
    m.def("decode_backward", &decode_backward);
    m.def("deform", &deform);
    m.def("deform_backward", &deform_backward);
#if defined(MASS_EMULATED)
    m.def("reverse_threads", [](bool reverse) { mass::emulator::machine().reverse = reverse; }, "The order in which threads run.");
#endif
}
