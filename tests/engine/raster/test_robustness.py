"""Bad numbers, bad arguments, and use from several graphs, threads and processes at once."""

from __future__ import annotations

import math
import multiprocessing
import threading
from dataclasses import replace
from typing import Any

import pytest
import torch

from mass_engine.camera import Camera
from mass_engine.errors import BadArgumentError
from mass_engine.raster import RasterOptions, rasterize
from tests.engine.raster.scenes import EVERYTHING, Surfels, camera, images, render, surfels, with_gradients

BAD = [math.nan, math.inf, -math.inf]


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_bad_numbers_are_dropped_and_counted(backend: str) -> None:
    options = replace(EVERYTHING, backend=backend)  # type: ignore[arg-type]
    scene, view = surfels("overlapping", 80, 0), camera()
    spoilt = scene.map(torch.Tensor.clone)
    spoilt.means[3, 1], spoilt.tangents[7, 0, 2], spoilt.tangents[11, 1, 1] = BAD
    spoilt.opacities[20], spoilt.colors[30, 2] = math.nan, math.inf
    spoilt.tangents[40, 0], spoilt.tangents[50, 1] = 0.0, 2 * spoilt.tangents[50, 0]  # no area
    bad = [3, 7, 11, 20, 30, 40, 50]
    keep = torch.ones(80, dtype=torch.bool)
    keep[bad] = False
    out, gradients = with_gradients(spoilt, view, options, torch.float32)
    clean = render(scene.map(lambda t: t[keep]), view, options)
    assert out.dropped == len(bad)
    assert clean.dropped == 0
    for name, image in images(clean).items():
        assert torch.equal(image, images(out)[name]), name
    for name in ("means", "tangents", "opacities", "colors"):
        assert torch.isfinite(gradients[name]).all(), name
        assert float(gradients[name][bad].abs().max()) == 0.0


@pytest.mark.parametrize("factor", [1e-30, 1e-12, 1e6, 1e18, 1e30])
@pytest.mark.parametrize("which", ["means", "tangents"])
def test_extreme_numbers_never_poison_the_image(which: str, factor: float) -> None:
    scene = surfels("overlapping", 50, 1)
    scene = replace(scene, **{which: getattr(scene, which) * factor})
    out, gradients = with_gradients(scene, camera(), EVERYTHING, torch.float32)
    for name, image in images(out).items():
        assert torch.isfinite(image).all(), name
    alpha = out.alpha.detach()
    assert 0.0 <= float(alpha.min()) <= float(alpha.max()) <= 1.0
    if factor > 1e-30:  # below, derivatives leave float32's range
        assert torch.isfinite(gradients["opacities"]).all()
        assert torch.isfinite(gradients["colors"]).all()


def test_exactly_edge_on_disks_show_their_low_pass_part() -> None:
    """The axis of view lies in the disk's plane: no plane to meet, and no gradient of it."""
    means = torch.tensor([[0.0, 0.0, 1.0]])
    for axis in ([0.0, 0.1, 0.0], [0.1, 0.0, 0.0]):
        leaves = [
            means.clone().requires_grad_(),
            torch.tensor([[axis, [0.0, 0.0, 0.1]]]).requires_grad_(),
        ]
        scene = Surfels(leaves[0], leaves[1], torch.tensor([0.8]), torch.ones(1, 3))
        out = render(scene, Camera.from_fov(9, 9, 30.0))
        alpha, depth = out.alpha.detach(), out.depth.detach()
        expected = 0.8 * math.exp(-1.0)
        assert float(alpha[4, 4]) == pytest.approx(0.8, abs=1e-5)
        assert float(alpha[4, 5]) == pytest.approx(expected, abs=1e-5)
        assert float(alpha[5, 4]) == pytest.approx(expected, abs=1e-5)
        assert float(depth[4, 5]) == pytest.approx(1.0, abs=1e-5)
        (out.rgb.sum() + out.depth.sum()).backward()
        assert all(leaf.grad is not None and bool(torch.isfinite(leaf.grad).all()) for leaf in leaves)
        assert float(leaves[1].grad.abs().max()) == 0.0  # type: ignore[union-attr]


def test_background_and_its_gradient() -> None:
    scene, view = surfels("overlapping", 30, 2), camera()
    background = torch.tensor([0.2, 0.5, 0.9], requires_grad=True)
    over = rasterize(*scene.tensors(), view, background=background)
    plain = rasterize(*scene.tensors(), view)
    torch.testing.assert_close(over.rgb, plain.rgb + (1 - plain.alpha)[..., None] * background)
    over.rgb.sum().backward()
    assert background.grad is not None
    torch.testing.assert_close(background.grad, (1 - plain.alpha).sum().expand(3), rtol=1e-4, atol=0)
    image = torch.rand(view.height, view.width, 3)
    behind = rasterize(*scene.tensors(), view, background=image)
    torch.testing.assert_close(behind.rgb, plain.rgb + (1 - plain.alpha)[..., None] * image)


def broken(**changes: Any) -> None:
    scene, view = surfels("overlapping", 5, 0), camera()
    names = ("means", "tangents", "opacities", "colors", "camera")
    arguments: dict[str, Any] = dict(zip(names, (*scene.tensors(), view), strict=True))
    arguments |= changes
    rasterize(**arguments)


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"means": torch.zeros(4, 3)}, "raster.shape"),
        ({"tangents": torch.ones(5, 3)}, "raster.shape"),
        ({"colors": torch.zeros(5, 5, 3)}, "raster.shape"),
        ({"opacities": torch.ones(5, 1)}, "raster.shape"),
        ({"colors": torch.zeros(5, 3, dtype=torch.uint8)}, "raster.dtype"),
        ({"background": torch.zeros(4)}, "raster.shape"),
        ({"means": torch.zeros(5, 3, device="meta")}, "raster.device"),
        ({"colors": torch.zeros(5, 3, device="meta")}, "raster.device"),
        ({"options": RasterOptions(backend="cuda")}, "raster.device"),
        ({"options": RasterOptions(pair_capacity=0)}, "raster.pair_capacity"),
        ({"camera": Camera(torch.eye(3), torch.eye(4), 0, 5)}, "raster.image_size"),
        ({"camera": Camera(torch.eye(3), torch.eye(4), 20_000, 5)}, "raster.image_size"),
        ({"camera": Camera(torch.eye(3) * math.nan, torch.eye(4), 5, 5)}, "raster.camera"),
        ({"options": RasterOptions(near=0.0)}, "raster.near"),
        ({"options": RasterOptions(threads=0)}, "raster.threads"),
        ({"options": RasterOptions(distortion_range=(1.0, 1.0))}, "raster.distortion_range"),
        ({"options": RasterOptions(window=(0, 0, 62, 1))}, "raster.window"),
        ({"options": RasterOptions(window=(5, -1, 2, 2))}, "raster.window"),
        ({"options": RasterOptions(convention="other")}, "raster.convention"),  # type: ignore[arg-type]
        ({"options": RasterOptions(instruction_set="mmx")}, "raster.instruction_set"),  # type: ignore[arg-type]
        ({"options": RasterOptions(without=frozenset({"luck"}))}, "raster.without"),  # type: ignore[arg-type]
        ({"options": RasterOptions(backend="gpu")}, "raster.backend"),  # type: ignore[arg-type]
        ({"options": RasterOptions(outputs="depth")}, "raster.outputs"),  # type: ignore[arg-type]
    ],
)
def test_bad_arguments_have_a_code(changes: dict[str, Any], code: str) -> None:
    with pytest.raises(BadArgumentError) as raised:
        broken(**changes)
    assert raised.value.code == code


def test_an_output_that_was_not_asked_for_says_so() -> None:
    out = render(surfels("overlapping", 5, 0), camera(), RasterOptions())
    with pytest.raises(BadArgumentError) as raised:
        _ = out.normal
    assert raised.value.code == "raster.output_not_computed"


def test_graphs_alive_at_once_do_not_share_buffers() -> None:
    """Several views rendered before any backward pass, as one fitting step over several cameras does."""
    scene = surfels("overlapping", 300, 3)
    views = [camera(61, 43), camera(33, 70), camera(90, 20)]
    alone = []
    for view in views:
        leaf = scene.means.clone().requires_grad_()
        out = render(replace(scene, means=leaf), view, EVERYTHING)
        out.rgb.sum().backward()
        alone.append(leaf.grad)
    leaves = [scene.means.clone().requires_grad_() for _ in views]
    outs = [
        render(replace(scene, means=leaf), view, EVERYTHING) for leaf, view in zip(leaves, views, strict=True)
    ]
    for out in reversed(outs):
        out.rgb.sum().backward(retain_graph=True)
    for leaf, expected in zip(leaves, alone, strict=True):
        assert leaf.grad is not None
        assert expected is not None
        assert torch.equal(leaf.grad, expected)
    outs[0].rgb.sum().backward()
    assert torch.equal(leaves[0].grad, 2 * alone[0])  # type: ignore[arg-type,operator]


def test_several_python_threads_share_one_renderer() -> None:
    view = camera(90, 70)
    scenes = [surfels("overlapping", 6000, seed) for seed in range(4)]
    options = replace(EVERYTHING, threads=2)
    expected = [render(scene, view, options).rgb for scene in scenes]
    wrong: list[int] = []

    def work(index: int) -> None:
        rendered = [render(scenes[index], view, options).rgb for _ in range(10)]
        wrong.extend(index for rgb in rendered if not torch.equal(rgb, expected[index]))

    workers = [threading.Thread(target=work, args=(i,)) for i in range(4)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(timeout=60)
    assert not any(worker.is_alive() for worker in workers)
    assert wrong == []


def _render_in_child(queue: Any) -> None:
    out = render(surfels("overlapping", 6000, 0), camera(), replace(EVERYTHING, threads=2))
    queue.put(float(out.rgb.double().sum()))


def test_a_forked_child_gets_threads_of_its_own() -> None:
    expected = float(
        render(surfels("overlapping", 6000, 0), camera(), replace(EVERYTHING, threads=2)).rgb.double().sum()
    )
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    child = context.Process(target=_render_in_child, args=(queue,))
    child.start()
    assert queue.get(timeout=60) == expected
    child.join(timeout=60)
    assert child.exitcode == 0
