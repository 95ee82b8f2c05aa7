// World surfels -> splats, boxes and depths: a thread each.
#define MASS_ISA device
#define MASS_WIDTH 0
#include "bounds.hpp"
#include "cuda_surfel.hpp"
#include "harmonics.hpp"

namespace mass::device {

template <int kHarmonics>
MASS_KERNEL(gpu::kSurfelThreads)
project_surfels(CameraData given, const float* pose, const float* K, SurfelData in, gpu::Frame out, bool with_normals, int* counters) {
    const int i = block_index() * gpu::kSurfelThreads + thread_index();
    const CameraData camera = placed(given, pose, K);
    if (i == 0) {
        float probe = 0.0f;
        for (int k = 0; k < 12; ++k) probe += 0.0f * pose[k];
        for (int k = 0; k < 6; ++k) probe += 0.0f * K[k];
        if (!(probe == 0.0f)) atomic_or(counters + gpu::kStatus, gpu::kBadCamera);
    }
    if (i >= in.count) return;
    SurfelLanes s = load_surfel(in, i);
    float color[3] = {s.color[0], s.color[1], s.color[2]};
    if constexpr (kHarmonics > 0) {
        float Y[16], d[3], h[48];
        view_direction(camera, s.mean, d);
        harmonic_basis(d, kHarmonics, Y);
        for (int k = 0; k < 3 * kHarmonics; ++k) h[k] = in.harmonics[static_cast<int64_t>(i) * 3 * kHarmonics + k];
        harmonic_color(Y, h, kHarmonics, s.color);
        for (int c = 0; c < 3; ++c) color[c] = max(s.color[c], 0.0f);
    }
    const Geometry g = make_geometry(camera, s);
    const Placement place = place_surfel(camera, s, g);
    if (g.bad) atomic_add(counters + gpu::kDropped, 1);

    out.index[i] = static_cast<uint32_t>(i);
    if (!place.seen) {
        out.boxes[i] = {0, -1, 0, -1};
        out.depth[i] = 0xffffffffu;
        return;
    }
    const PixelBounds& b = place.bounds;
    const Box box = {static_cast<int16_t>(b.x0), static_cast<int16_t>(b.x1), static_cast<int16_t>(b.y0), static_cast<int16_t>(b.y1)};
    out.boxes[i] = box;
    memcpy(out.depth + i, &g.c[2], sizeof(float));  // positive, so its bits sort as an integer
    const float narrow = low_pass_only(g, place.reach, b.crossing) ? 1.0f : 0.0f;
    out.splats[i] = {g.mx, g.my, g.a1, g.a2, g.b1, g.b2, g.g1, g.g2, g.c[2], s.opacity, color[0], color[1], color[2], narrow, box};
    if (with_normals) {
        float normal[3];
        normal_to_camera(g, normal);
        out.normals[i] = {normal[0], normal[1], normal[2], 0.0f};
    }
}

}  // namespace mass::device

namespace mass::gpu {

void project(const Call& call, int* counters) {
    // One block at least: the camera is looked at even when there is no surfel.
    const int blocks = surfel_blocks(call.shape.surfels > 0 ? call.shape.surfels : 1);
    for_harmonics(call.surfels, [&](auto harmonics) {
        launch(device::project_surfels<decltype(harmonics)::value>, blocks, kSurfelThreads, static_cast<Stream>(call.stream), call.camera,
               call.pose, call.K, call.surfels, call.frame, call.shape.extra, counters);
    });
}

}  // namespace mass::gpu
