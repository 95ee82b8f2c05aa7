// Python bindings of the deformation's kernels. Arrays are DLPack views of contiguous float32 CPU tensors; the callers
// in mass_engine/deform have checked their shapes.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <memory>
#include <vector>

#include "cpu_features.hpp"
#include "tables.hpp"
#include "thread_pool.hpp"

namespace nb = nanobind;

namespace {

using In = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;
using Out = nb::ndarray<float, nb::c_contig, nb::device::cpu>;
using Index = nb::ndarray<const int32_t, nb::c_contig, nb::device::cpu>;

std::vector<const mass::DeformTable*> tables() {
    std::vector<const mass::DeformTable*> found;
#if defined(MASS_BUILD_X86)
    if (mass::has_avx512()) found.push_back(&mass::avx512::deform_table);
    if (mass::has_avx2()) found.push_back(&mass::avx2::deform_table);
#endif
    found.push_back(&mass::portable::deform_table);
    found.push_back(&mass::scalar::deform_table);
    return found;
}

// The weights as the kernels want them: padded, and transposed for the backward pass.
struct Weights {
    std::vector<float> head, head_bias, second_transposed, head_transposed;

    Weights(const In& second, const In& given_head, const float* bias, int hidden) {
        const auto H = static_cast<std::size_t>(hidden);
        head.assign(H * mass::kPaddedOutputs, 0.0f);
        head_bias.assign(mass::kPaddedOutputs, 0.0f);
        second_transposed.resize(H * H);
        head_transposed.resize(H * mass::kOutputs);
        for (std::size_t k = 0; k < H; ++k) {
            for (std::size_t o = 0; o < mass::kOutputs; ++o) {
                const float value = given_head.data()[k * mass::kOutputs + o];
                head[k * mass::kPaddedOutputs + o] = value;
                head_transposed[o * H + k] = value;
            }
            for (std::size_t j = 0; j < H; ++j) second_transposed[j * H + k] = second.data()[k * H + j];
        }
        if (bias) std::copy(bias, bias + mass::kOutputs, head_bias.begin());
    }
};

class Kernels {
public:
    explicit Kernels(const std::string& instruction_set) : table_(mass::choose_table(tables(), instruction_set)) {}

    std::string instruction_set() const { return table_->name; }

    void decode(const In& share, const In& pose, const In& second, const In& second_bias, const In& head, const In& head_bias,
                float offset_unit, float rotation_unit, Out& offset, Out& log_scale, Out& rotation, Out& mask_logit, int threads) {
        mass::DecoderData d = data(share, pose, second, second_bias, offset_unit, rotation_unit);
        const Weights weights(second, head, head_bias.data(), d.hidden);
        d.head = weights.head.data();
        d.head_bias = weights.head_bias.data();
        const mass::ResidualRows out{offset.data(), log_scale.data(), rotation.data(), mask_logit.data()};
        nb::gil_scoped_release release;
        each_chunk(d.count, threads, [&](int, int begin, int end) { table_->decode(d, out, begin, end); });
    }

    void decode_backward(const In& share, const In& pose, const In& second, const In& second_bias, const In& head,
                         float offset_unit, float rotation_unit, const In& d_offset, const In& d_log_scale,
                         const In& d_rotation, const In& d_mask_logit, const In& log_scale, Out& d_share, Out& d_pose, Out& d_second, Out& d_second_bias, Out& d_head,
                         Out& d_head_bias, int threads) {
        mass::DecoderData d = data(share, pose, second, second_bias, offset_unit, rotation_unit);
        const Weights weights(second, head, nullptr, d.hidden);
        d.second_transposed = weights.second_transposed.data();
        d.head_transposed = weights.head_transposed.data();
        const auto H = static_cast<std::size_t>(d.hidden), B = static_cast<std::size_t>(d.batch);
        const auto size = static_cast<std::size_t>(mass::DecoderSums::size(d.hidden, d.batch));
        float *share_out = d_share.data(), *pose_out = d_pose.data(), *second_out = d_second.data();
        float *second_bias_out = d_second_bias.data(), *head_out = d_head.data(), *head_bias_out = d_head_bias.data();
        const mass::ResidualRowGradients gradient{d_offset.data(), d_log_scale.data(), d_rotation.data(), d_mask_logit.data(),
                                                  log_scale.data()};
        nb::gil_scoped_release release;
        const auto chunks = static_cast<std::size_t>(chunk_count(d.count));
        std::vector<float> partial(chunks * size, 0.0f);
        each_chunk(d.count, threads, [&](int chunk, int begin, int end) {
            float* at = partial.data() + static_cast<std::size_t>(chunk) * size;
            mass::DecoderSums sums{};
            sums.second = at;
            sums.second_bias = (at += H * H);
            sums.head_transposed = (at += H);
            sums.head_bias = (at += mass::kOutputs * H);
            sums.pose = at + mass::kPaddedOutputs;
            table_->decode_backward(d, gradient, share_out, sums, begin, end);
        });
        // In the chunks' order, whoever computed them.
        std::vector<double> total(size, 0.0);
        for (std::size_t chunk = 0; chunk < chunks; ++chunk) {
            for (std::size_t k = 0; k < size; ++k) total[k] += static_cast<double>(partial[chunk * size + k]);
        }
        std::size_t at = 0;
        const auto take = [&](float* to, std::size_t n) {
            for (std::size_t k = 0; k < n; ++k) to[k] = static_cast<float>(total[at + k]);
            at += n;
        };
        take(second_out, H * H);
        take(second_bias_out, H);
        for (std::size_t o = 0; o < mass::kOutputs; ++o) {
            for (std::size_t k = 0; k < H; ++k) head_out[k * mass::kOutputs + o] = static_cast<float>(total[at++]);
        }
        take(head_bias_out, mass::kOutputs);
        at += mass::kPaddedOutputs - mass::kOutputs;
        take(pose_out, B * H);
    }

    void deform(const In& means, const In& tangents, const In& normals, const In& offset, const In& log_scale,
                const In& rotation, Out& means_out, Out& tangents_out, Out& normals_out, int threads) {
        const mass::ResidualData d{means.data(), tangents.data(), normals.data(), offset.data(), log_scale.data(), rotation.data()};
        float *m = means_out.data(), *t = tangents_out.data(), *n = normals_out.data();
        const int rows = static_cast<int>(means.size() / 3);
        nb::gil_scoped_release release;
        each_chunk(rows, threads, [&](int, int begin, int end) { table_->deform(d, m, t, n, begin, end); });
    }

    void deform_backward(const In& tangents, const In& normals, const In& offset, const In& log_scale, const In& rotation,
                         const In& d_means_in, const In& d_tangents_in, const In& d_normals_in, Out& d_tangents, Out& d_normals,
                         Out& d_offset, Out& d_log_scale, Out& d_rotation, int threads) {
        const mass::ResidualData d{nullptr, tangents.data(), normals.data(), offset.data(), log_scale.data(), rotation.data()};
        const mass::ResidualGradient g{d_means_in.data(), d_tangents_in.data(), d_normals_in.data(), d_tangents.data(),
                                       d_normals.data(), d_offset.data(), d_log_scale.data(), d_rotation.data()};
        const int rows = static_cast<int>(normals.size() / 3);
        nb::gil_scoped_release release;
        each_chunk(rows, threads, [&](int, int begin, int end) { table_->deform_backward(d, g, begin, end); });
    }

    // `center_units` is the camera's place and the two units.
    void pose_surfels(const In& vertices, const Index& corners, const Index& places, const In& coefficients, const Index& bones,
                      const In& rotations, const In& albedo, const In& harmonics, const In& opacities, const In& light,
                      const std::vector<float>& center_units, int deformed_from, const In& fixed, const In& share, const In& pose,
                      const In& second, const In& second_bias, const In& head, const In& head_bias, Out& means, Out& tangents,
                      Out& normals, Out& opacities_out, Out& colors, int threads) {
        if (center_units.size() != 5) throw std::invalid_argument("center_units needs 5 numbers");
        mass::PosingData d{};
        d.vertices = vertices.data();
        d.corners = corners.data();
        d.places = places.data();
        d.coefficients = coefficients.data();
        d.bones = bones.data();
        d.rotations = rotations.data();
        d.albedo = albedo.data();
        d.harmonics = harmonics.data();
        d.opacities = opacities.data();
        d.light = light.data();
        for (std::size_t k = 0; k < 3; ++k) d.center[k] = center_units[k];
        d.count = static_cast<int>(means.shape(0));
        d.stride = static_cast<int>(albedo.shape(1));
        d.harmonics_count = static_cast<int>(harmonics.shape(0)) / 3;
        d.deformed_from = deformed_from;
        d.fixed = fixed.shape(0) == 8 ? fixed.data() : nullptr;
        d.decoder = data(share, pose, second, second_bias, center_units[3], center_units[4]);
        const Weights weights(second, head, head_bias.data(), d.decoder.hidden);
        d.decoder.head = weights.head.data();
        d.decoder.head_bias = weights.head_bias.data();
        const mass::PosedData out{means.data(), tangents.data(), normals.data(), opacities_out.data(), colors.data()};
        nb::gil_scoped_release release;
        each_chunk(d.count, threads, [&](int, int begin, int end) { table_->pose_surfels(d, out, begin, end); });
    }

private:
    static mass::DecoderData data(const In& share, const In& pose, const In& second, const In& second_bias, float offset_unit,
                                  float rotation_unit) {
        mass::DecoderData d{};
        d.share = share.data();
        d.pose = pose.data();
        d.second = second.data();
        d.second_bias = second_bias.data();
        d.count = static_cast<int>(share.shape(0));
        d.hidden = static_cast<int>(share.shape(1));
        d.batch = static_cast<int>(pose.shape(0));
        d.offset_unit = offset_unit;
        d.rotation_unit = rotation_unit;
        return d;
    }

    static int chunk_count(int count) { return (count + mass::kDecoderChunk - 1) / mass::kDecoderChunk; }

    template <class Body>
    void each_chunk(int count, int threads, Body body) {
        pool_.loop(chunk_count(count), threads, [&](int chunk) {
            const int begin = chunk * mass::kDecoderChunk;
            body(chunk, begin, std::min(count, begin + mass::kDecoderChunk));
        });
    }

    const mass::DeformTable* table_;
    mass::ThreadPool pool_;
};

}  // namespace

NB_MODULE(_kernels, m) {
    m.doc() = "Compiled kernels of the deformation (see mass_engine.deform.decoder and posing).";
    // Kernels held by globals live until the process ends: not a leak worth a report.
    nb::set_leak_warnings(false);
    m.def("instruction_sets", [] {
        nb::list names;
        for (const auto* table : tables()) names.append(table->name);
        return names;
    });
    nb::class_<Kernels>(m, "Kernels", "The kernels of one instruction set and their threads. Calls may come from any thread.")
        .def(nb::init<const std::string&>(), nb::arg("instruction_set") = "auto")
        .def_prop_ro("instruction_set", &Kernels::instruction_set)
        .def("decode", &Kernels::decode)
        .def("decode_backward", &Kernels::decode_backward)
        .def("deform", &Kernels::deform)
        .def("deform_backward", &Kernels::deform_backward)
        .def("pose_surfels", &Kernels::pose_surfels);
}
