"""The compiled kernels against the reference in float64.

Tolerances: the kernels compute in float32, with pixel coordinates good to about 1e-5 px at these sizes, so an
image may differ by 1e-4 where nothing is discontinuous. Rounding can move a surfel across the alpha cut, the
stopping rule or the low-pass switch at a pixel; then the image changes by up to 1/255 (cut) or a hundredth
(stop), and a depth by more. At most 0.5 % of pixels may do so. A gradient may differ by 5e-3 of its norm:
nearly edge-on disks multiply rounding by the inverse of the cosine.
"""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from mass_engine.raster import RasterOptions
from mass_engine.raster._kernels import instruction_sets
from mass_engine.raster.types import Convention
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
CASES = [(1, 0, (61, 43)), (40, 1, (61, 43)), (300, 2, (33, 50))]


def check_images(scene: Surfels, size: tuple[int, int], options: RasterOptions) -> None:
    view = camera(*size)
    with torch.no_grad():
        expected = render(scene.map(torch.Tensor.double), view, replace(options, backend="reference"))
        got = render(scene, view, options)
    assert got.dropped == expected.dropped
    for name, image in images(got).items():
        error = (image - images(expected)[name]).abs()
        assert float((error > 1e-4).float().mean()) <= 0.005, name
        if "depth" not in name:
            assert float(error.max()) <= 0.02, name
    if options.outputs == "all":
        scale = 1e-4 + 1e-3 * expected.weight_sum
        assert float(((got.weight_sum - expected.weight_sum).abs() > scale).float().mean()) <= 0.01


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("case", CASES)
def test_images_and_gradients(kind: str, case: tuple[int, int, tuple[int, int]]) -> None:
    count, seed, size = case
    scene, view = surfels(kind, count, seed), camera(*size)
    check_images(scene, size, EVERYTHING)
    # A depth divides by alpha: weigh its gradient by it, or the faintest pixels decide.
    alpha = render(scene, view).alpha
    weights = dict.fromkeys(("rgb", "alpha", "normal", "distortion"), torch.ones(()))
    weights |= {"depth": alpha, "median_depth": alpha}
    _, expected = with_gradients(scene, view, REFERENCE, torch.float64, weights=weights)
    _, got = with_gradients(scene, view, EVERYTHING, torch.float32, weights=weights)
    for name, gradient in expected.items():
        assert torch.isfinite(got[name]).all(), name
        assert float((got[name] - gradient).norm()) <= 5e-3 * float(gradient.norm()), name


@pytest.mark.parametrize("name", instruction_sets())
@pytest.mark.parametrize("outputs", ["color", "all"])
def test_every_instruction_set(name: str, outputs: str) -> None:
    options = replace(EVERYTHING, outputs=outputs, instruction_set=name)  # type: ignore[arg-type]
    scene, view = surfels("overlapping", 200, 5), camera()
    check_images(scene, (61, 43), options)
    _, expected = with_gradients(scene, view, replace(options, backend="reference"), torch.float64)
    _, got = with_gradients(scene, view, options, torch.float32)
    for key, gradient in expected.items():
        assert float((got[key] - gradient).norm()) <= 1e-3 * float(gradient.norm()), key


@pytest.mark.parametrize("size", [(1, 1), (3, 70), (16, 16), (17, 15), (129, 5)])
def test_odd_sizes(size: tuple[int, int]) -> None:
    check_images(surfels("overlapping", 150, 3), size, EVERYTHING)


def test_backface_culling_drops_what_faces_away() -> None:
    scene, options = surfels("overlapping", 200, 4), replace(EVERYTHING, cull_backfaces=True)
    check_images(scene, (61, 43), options)
    kept = (render(scene, camera(), options).weight_sum > 0).sum()
    assert 0 < int(kept) < int((render(scene, camera()).weight_sum > 0).sum())


def test_no_surfel_at_all() -> None:
    empty = surfels("overlapping", 4, 0).map(lambda t: t[:0])
    out, gradients = with_gradients(empty, camera(), EVERYTHING, torch.float32)
    assert all(float(image.detach().abs().max()) == 0.0 for image in images(out).values())
    assert all(float(gradients[k].abs().max()) == 0.0 for k in ("world_to_camera", "K"))


def test_a_hundred_thousand_surfels() -> None:
    scene = surfels("overlapping", 100_000, 6)
    scene = replace(scene, tangents=0.05 * scene.tangents)
    check_images(scene, (11, 9), EVERYTHING)


@pytest.mark.parametrize("harmonics", [1, 4, 9, 16])
def test_harmonics(harmonics: int) -> None:
    scene, view = surfels("overlapping", 150, 8, harmonics), camera()
    check_images(scene, (61, 43), EVERYTHING)
    assert float(render(scene, view).rgb.std()) > 0.02
    _, expected = with_gradients(scene, view, REFERENCE, torch.float64)
    _, got = with_gradients(scene, view, EVERYTHING, torch.float32)
    for key, gradient in expected.items():
        assert float((got[key] - gradient).norm()) <= 1e-3 * float(gradient.norm()), key


@pytest.mark.parametrize("convention", ["inria", "gsplat"])
@pytest.mark.parametrize("kind", ["overlapping", "huge", "grazing"])
def test_conventions_of_other_renderers(kind: str, convention: Convention) -> None:
    """Kernels and reference draw the same whole tiles and the same depths."""
    options = replace(EVERYTHING, convention=convention)
    scene, view = surfels(kind, 60, 4), camera(90, 70)
    check_images(scene, (90, 70), options)
    _, expected = with_gradients(scene, view, replace(options, backend="reference"), torch.float64)
    _, got = with_gradients(scene, view, options, torch.float32)
    for key in ("means", "tangents", "opacities", "colors"):
        assert float((got[key] - expected[key]).norm()) <= 5e-3 * float(expected[key].norm()), key


def test_part_of_the_gradients() -> None:
    """Gradients into a single image only: the others count as zero."""
    scene, view = surfels("overlapping", 60, 7), camera()
    for name in images(render(scene, view)):
        weights = dict.fromkeys(images(render(scene, view)), torch.zeros(())) | {name: torch.ones(())}
        _, expected = with_gradients(scene, view, REFERENCE, torch.float64, weights=weights)
        leaves = [t.clone().requires_grad_() for t in scene.tensors()]
        image = images(render(Surfels(*leaves), view))[name]
        g = torch.Generator().manual_seed(99)
        for other in images(render(scene, view)):
            weight = torch.randn(images(render(scene, view))[other].shape, generator=g)
            if other == name:
                break
        (image * weight).sum().backward()
        for key, leaf in zip(("means", "tangents", "opacities", "colors"), leaves, strict=True):
            got = torch.zeros_like(leaf) if leaf.grad is None else leaf.grad
            assert float((got - expected[key]).norm()) <= 5e-3 * float(expected[key].norm()) + 1e-12, (
                name,
                key,
            )
