"""The GPU kernels in the emulation: against the reference, against the CPU's kernels, and what a GPU adds.

Tolerances are those of ``test_agreement``.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import pytest
import torch

from mass_engine.camera import Camera
from mass_engine.errors import BadArgumentError, EngineError
from mass_engine.raster import RasterOptions, RenderOutput, cuda
from mass_engine.raster.types import Convention
from tests.engine.raster.scenes import (
    EVERYTHING,
    KINDS,
    Draw,
    Surfels,
    camera,
    images,
    render,
    surfels,
    with_gradients,
)
from tests.gpu import gpu_problem

REFERENCE = replace(EVERYTHING, backend="reference")
COLOR = replace(EVERYTHING, outputs="color")
SIZE = (45, 34)


@pytest.fixture
def draw(emulated: cuda.Backend) -> Draw:
    return partial(cuda.rasterize, backend=emulated)


def check_images(scene: Surfels, view: Camera, options: RasterOptions, draw: Draw) -> None:
    with torch.no_grad():
        expected = render(scene.map(torch.Tensor.double), view, replace(options, backend="reference"))
        got = render(scene, view, options, draw)
    assert got.dropped == expected.dropped
    for name, image in images(got).items():
        error = (image - images(expected)[name]).abs()
        assert float((error > 1e-4).float().mean()) <= 0.005, name
        if "depth" not in name:
            assert float(error.detach().max()) <= 0.02, name
    if options.outputs == "all":
        scale = 1e-4 + 1e-3 * expected.weight_sum
        assert float(((got.weight_sum - expected.weight_sum).abs() > scale).float().mean()) <= 0.01


def check_gradients(scene: Surfels, view: Camera, options: RasterOptions, draw: Draw) -> None:
    # A depth divides by alpha: weigh its gradient by it, or the faintest pixels decide.
    alpha = render(scene, view).alpha
    weights = dict.fromkeys(("rgb", "alpha", "normal", "distortion"), torch.ones(()))
    weights |= {"depth": alpha, "median_depth": alpha}
    slow = replace(options, backend="reference")
    _, expected = with_gradients(scene, view, slow, torch.float64, weights)
    _, got = with_gradients(scene, view, options, torch.float32, weights, draw)
    for name, gradient in expected.items():
        assert torch.isfinite(got[name]).all(), name
        assert float((got[name] - gradient).norm()) <= 5e-3 * float(gradient.norm()), name


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", [1, 120])
def test_images_and_gradients(kind: str, count: int, draw: Draw) -> None:
    scene, view = surfels(kind, count, 1), camera(*SIZE)
    check_images(scene, view, EVERYTHING, draw)
    check_gradients(scene, view, EVERYTHING, draw)


@pytest.mark.parametrize("harmonics", [1, 4, 9, 16])
def test_harmonics(harmonics: int, draw: Draw) -> None:
    scene, view = surfels("overlapping", 60, 8, harmonics), camera(*SIZE)
    check_images(scene, view, COLOR, draw)
    check_gradients(scene, view, COLOR, draw)


@pytest.mark.parametrize("size", [(1, 1), (3, 70), (17, 15), (129, 5)])
def test_odd_sizes(size: tuple[int, int], draw: Draw) -> None:
    check_images(surfels("overlapping", 80, 3), camera(*size), EVERYTHING, draw)


def test_backface_culling(draw: Draw) -> None:
    scene, options = surfels("overlapping", 100, 4), replace(EVERYTHING, cull_backfaces=True)
    check_images(scene, camera(*SIZE), options, draw)
    check_gradients(scene, camera(*SIZE), options, draw)


@pytest.mark.parametrize("convention", ["inria", "gsplat"])
def test_conventions_of_other_renderers(convention: Convention, draw: Draw) -> None:
    scene, options = surfels("overlapping", 60, 4), replace(EVERYTHING, convention=convention)
    check_images(scene, camera(*SIZE), options, draw)
    check_gradients(scene, camera(*SIZE), options, draw)


def close(got: RenderOutput, expected: RenderOutput) -> None:
    for name, image in images(got).items():
        error = (image - images(expected)[name]).abs()
        assert float((error > 2e-4).float().mean()) <= 0.002, name
        if "depth" not in name:
            assert float(error.detach().max()) <= 0.02, name


def test_as_the_cpu_kernels_on_a_larger_picture(draw: Draw) -> None:
    """Lists of many batches, tiles without a surfel, pixels that end early."""
    scene, view = surfels("opaque", 6000, 2), camera(131, 83)
    scene = replace(scene, means=scene.means * torch.tensor([0.4, 0.6, 1.0]), tangents=0.25 * scene.tangents)
    expected, wanted = with_gradients(scene, view, EVERYTHING, torch.float32)
    got, gradients = with_gradients(scene, view, EVERYTHING, torch.float32, draw=draw)
    assert float((expected.alpha == 0).float().mean()) > 0.2
    assert float((expected.alpha > 0.999).float().mean()) > 0.1
    close(got, expected)
    for name, gradient in wanted.items():
        assert float((gradients[name] - gradient).norm()) <= 1e-2 * float(gradient.norm()), name


def test_the_same_bits_in_whatever_order_threads_run(draw: Draw, emulated: cuda.Backend) -> None:
    scene, view = surfels("overlapping", 500, 5), camera(*SIZE)
    first, gradients = with_gradients(scene, view, EVERYTHING, torch.float32, draw=draw)
    for reverse in (False, True):
        emulated.kernels.reverse_threads(reverse)
        try:
            again, others = with_gradients(scene, view, EVERYTHING, torch.float32, draw=draw)
        finally:
            emulated.kernels.reverse_threads(False)
        for name, image in images(first).items():
            assert torch.equal(image, images(again)[name]), name
        assert torch.equal(first.weight_sum, again.weight_sum)
        for name, gradient in gradients.items():
            assert torch.equal(gradient, others[name]), name


def test_too_little_room_is_found_out(emulated: cuda.Backend, draw: Draw) -> None:
    scene, view = surfels("huge", 50, 2), camera(*SIZE)
    small = replace(EVERYTHING, pair_capacity=37)
    out, gradients = with_gradients(scene, view, small, torch.float32, draw=draw)
    assert out.dropped == -1
    assert out.counters is not None
    with pytest.raises(EngineError, match=r"raster\.too_many_pairs"):
        cuda.check_counters(out.counters)
    assert all(torch.isfinite(g).all() for g in gradients.values())
    needed = int(out.counters[1])
    exact, _ = with_gradients(scene, view, replace(small, pair_capacity=needed), torch.float32, draw=draw)
    assert exact.counters is not None
    assert cuda.check_counters(exact.counters) == 0
    roomy = render(scene, view, EVERYTHING, draw)
    for name, image in images(roomy).items():
        assert torch.equal(image, images(exact)[name]), name


def test_a_frame_that_needs_more_room_is_drawn_again(emulated: cuda.Backend) -> None:
    fresh = cuda.Backend(emulated.kernels)
    scene, view = surfels("huge", 3000, 2), camera(130, 130)
    scene = replace(scene, opacities=0.01 + 0 * scene.opacities)
    call = cuda.Call(view.width, view.height, COLOR, fresh)
    before = fresh.room(3000)
    with torch.no_grad():
        call.run(*scene.tensors(), view.world_to_camera, view.K)
    assert call.pairs > before
    assert call.dropped == 0
    assert fresh.room(3000) >= call.pairs


def test_no_surfel_at_all(draw: Draw) -> None:
    empty = surfels("overlapping", 4, 0).map(lambda t: t[:0])
    out, gradients = with_gradients(empty, camera(), EVERYTHING, torch.float32, draw=draw)
    assert out.dropped == 0
    assert all(float(image.detach().abs().max()) == 0.0 for image in images(out).values())
    assert all(float(gradients[k].abs().max()) == 0.0 for k in ("world_to_camera", "K"))


def test_bad_numbers_are_dropped_and_counted(draw: Draw) -> None:
    scene, view = surfels("overlapping", 60, 0), camera(*SIZE)
    spoilt = scene.map(torch.Tensor.clone)
    spoilt.means[3, 1], spoilt.tangents[7, 0, 2] = math.nan, math.inf
    spoilt.opacities[20], spoilt.colors[30, 2] = math.nan, -math.inf
    spoilt.tangents[40, 0] = 0.0
    bad = [3, 7, 20, 30, 40]
    keep = torch.ones(60, dtype=torch.bool)
    keep[bad] = False
    out, gradients = with_gradients(spoilt, view, EVERYTHING, torch.float32, draw=draw)
    clean = render(scene.map(lambda t: t[keep]), view, EVERYTHING, draw)
    assert out.dropped == len(bad)
    for name, image in images(clean).items():
        assert torch.equal(image, images(out)[name]), name
    for name in ("means", "tangents", "opacities", "colors"):
        assert torch.isfinite(gradients[name]).all(), name
        assert float(gradients[name][bad].abs().max()) == 0.0


@pytest.mark.parametrize("surfel_count", [0, 5])
def test_a_bad_camera_is_found_by_the_kernels(surfel_count: int, draw: Draw) -> None:
    view = camera(*SIZE)
    view.K[0, 0] = math.nan
    scene = surfels("overlapping", 5, 0).map(lambda t: t[:surfel_count])
    with pytest.raises(BadArgumentError, match=r"raster\.camera"):
        render(scene, view, EVERYTHING, draw)


def test_gradients_of_one_image_alone(draw: Draw) -> None:
    """Gradients that do not come are zero."""
    scene, view = surfels("overlapping", 60, 7), camera(*SIZE)
    for name in ("alpha", "distortion"):
        results = []
        for options, with_draw in ((EVERYTHING, {"draw": draw}), (EVERYTHING, {})):
            leaves = [t.clone().requires_grad_() for t in scene.tensors()]
            images(render(Surfels(*leaves), view, options, **with_draw))[name].sum().backward()
            results.append([torch.zeros_like(x) if x.grad is None else x.grad for x in leaves])
        for got, expected in zip(*results, strict=True):
            assert float((got - expected).norm()) <= 1e-3 * float(expected.norm()) + 1e-12, name


def test_no_gpu_is_a_clear_error() -> None:
    if gpu_problem():
        with pytest.raises(EngineError, match=r"device\.unavailable"):
            cuda.import_kernels()
    else:
        assert cuda.import_kernels().problem() == ""
