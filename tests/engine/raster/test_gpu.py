"""The kernels on a GPU; collected only where there is one. Tolerances are those of ``test_agreement``."""

from __future__ import annotations

from dataclasses import fields, replace

import pytest
import torch
from torch import Tensor

from mass_engine.camera import Camera
from mass_engine.errors import BadArgumentError, EngineError
from mass_engine.evaluation.raster_cuda import captured
from mass_engine.evaluation.raster_scene import hand_camera, hand_scene
from mass_engine.raster import Extras, RasterOptions, RenderOutput, cuda, rasterize
from tests.engine.raster.scenes import (
    EVERYTHING,
    KINDS,
    Surfels,
    camera,
    images,
    render,
    surfels,
    with_gradients,
)

REFERENCE = replace(EVERYTHING, backend="reference")


def on_gpu(view: Camera) -> Camera:
    return Camera(view.K.cuda(), view.world_to_camera.cuda(), view.width, view.height)


def draw(
    means: Tensor,
    tangents: Tensor,
    opacities: Tensor,
    colors: Tensor,
    camera: Camera,
    *,
    options: RasterOptions,
) -> RenderOutput:
    """Tensors from the CPU and back, computed on the GPU."""
    scene = Surfels(means, tangents, opacities, colors).map(torch.Tensor.cuda)
    out = rasterize(*scene.tensors(), on_gpu(camera), options=options)
    assert out.extras is not None
    extras = Extras(*(getattr(out.extras, f.name).cpu() for f in fields(Extras)))
    return RenderOutput(out.rgb.cpu(), out.alpha.cpu(), out.depth.cpu(), out.dropped, extras)


@pytest.mark.parametrize("harmonics", [0, 16])
@pytest.mark.parametrize("kind", KINDS)
def test_value_and_gradient_against_the_reference(kind: str, harmonics: int) -> None:
    scene, view = surfels(kind, 300, 2, harmonics), camera(61, 43)
    alpha = rasterize(*scene.tensors(), view).alpha
    weights = dict.fromkeys(("rgb", "alpha", "normal", "distortion"), torch.ones(()))
    weights |= {"depth": alpha, "median_depth": alpha}
    expected, gradients = with_gradients(scene, view, REFERENCE, torch.float64, weights)

    got, others = with_gradients(scene, view, EVERYTHING, torch.float32, weights, draw)
    assert got.dropped == expected.dropped
    for name, image in images(got).items():
        error = (image - images(expected)[name]).abs()
        assert float((error > 1e-4).float().mean()) <= 0.005, name
    for name, gradient in gradients.items():
        assert float((others[name] - gradient).norm()) <= 5e-3 * float(gradient.norm()), name


def test_the_cpu_and_the_gpu_draw_the_same_hand() -> None:
    scene = hand_scene(49_216)
    view = hand_camera(scene, 512, 334)
    expected = rasterize(*scene.tensors(), view, options=EVERYTHING)
    got = rasterize(*scene.to(torch.device("cuda")).tensors(), view, options=EVERYTHING)
    for name, image in images(got).items():
        error = (image.cpu() - images(expected)[name]).abs()
        assert float((error > 2e-4).float().mean()) <= 0.002, name
    worst = (got.weight_sum.cpu() - expected.weight_sum).abs().max()
    assert float(worst) <= 0.05


def test_the_same_bits_every_time() -> None:
    scene = hand_scene(49_216)
    view = on_gpu(hand_camera(scene, 512, 334))
    leaves = [t.cuda().requires_grad_() for t in scene.tensors()]

    def step() -> list[torch.Tensor]:
        out = render(Surfels(*leaves), view)
        made = list(images(out).values())
        return [*made, *torch.autograd.grad(made, leaves, [torch.ones_like(i) for i in made])]

    first = step()
    for _ in range(5):
        for a, b in zip(first, step(), strict=True):
            assert torch.equal(a, b)


def test_a_captured_step_is_the_same_step() -> None:
    """A CUDA graph: no host synchronisation, no size that depends on the data."""
    scene = hand_scene(12_304)
    view = on_gpu(hand_camera(scene, 256, 256))
    leaves = [t.cuda().requires_grad_() for t in scene.tensors()]
    options = replace(EVERYTHING, pair_capacity=200_000)
    kept: dict[str, list[torch.Tensor]] = {}

    def step() -> None:
        out = render(Surfels(*leaves), view, options)
        made = list(images(out).values())
        assert out.counters is not None
        gradients = torch.autograd.grad(made, leaves, [torch.ones_like(i) for i in made])
        kept["made"], kept["counters"] = [*made, *gradients], [out.counters]

    step()
    eager = [t.detach().clone() for t in kept["made"]]
    captured(step)()
    torch.cuda.synchronize()
    assert cuda.check_counters(kept["counters"][0]) == 0
    for a, b in zip(eager, kept["made"], strict=True):
        assert torch.equal(a, b)


def test_too_little_room_and_bad_cameras_are_errors() -> None:
    scene = surfels("huge", 50, 2).map(torch.Tensor.cuda)
    out = rasterize(*scene.tensors(), camera(), options=replace(EVERYTHING, pair_capacity=37))
    assert out.counters is not None
    with pytest.raises(EngineError, match=r"raster\.too_many_pairs"):
        cuda.check_counters(out.counters)
    view = on_gpu(camera())
    view.K[0, 0] = torch.nan
    with pytest.raises(BadArgumentError, match=r"raster\.camera"):
        rasterize(*scene.tensors(), view)


def test_tensors_on_two_devices_are_refused() -> None:
    scene = surfels("overlapping", 5, 0)
    mixed = Surfels(scene.means.cuda(), scene.tangents, scene.opacities, scene.colors)
    with pytest.raises(BadArgumentError, match=r"raster\.device"):
        rasterize(*mixed.tensors(), camera())
