"""What must not matter: the input's order, the world's origin, how the image is cut, the threads."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mass_engine.camera import Camera
from mass_engine.raster._kernels import instruction_sets
from mass_engine.surfel.inellipse import quat_to_matrix
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

kinds = st.sampled_from([k for k in KINDS if k != "twins"])
seeds = st.integers(0, 10_000)
few = settings(max_examples=25, deadline=None, derandomize=True)


@few
@given(kinds, seeds, st.integers(1, 120))
def test_the_order_of_the_input_does_not_matter(kind: str, seed: int, count: int) -> None:
    scene, view = surfels(kind, count, seed), camera()
    order = torch.randperm(count, generator=torch.Generator().manual_seed(seed))
    straight, mixed = render(scene, view), render(scene.map(lambda t: t[order]), view)
    for name, image in images(straight).items():
        assert torch.equal(image, images(mixed)[name]), name
    assert torch.equal(straight.weight_sum[order], mixed.weight_sum)


def moved(scene: Surfels, view: Camera, seed: int) -> tuple[Surfels, Camera]:
    """The same scene and camera in another world frame."""
    g = torch.Generator().manual_seed(seed)
    turn = torch.randn(1, 4, generator=g, dtype=torch.float64)
    R, t = quat_to_matrix(turn / turn.norm())[0], torch.randn(3, generator=g, dtype=torch.float64)
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3], motion[:3, 3] = R, t
    pose = view.world_to_camera.double() @ torch.linalg.inv(motion)
    made = replace(
        scene,
        means=(scene.means.double() @ R.T + t).float(),
        tangents=(scene.tangents.double() @ R.T).float(),
    )
    return made, replace(view, world_to_camera=pose.float())


@few
@given(st.sampled_from(["overlapping", "tiny", "opaque", "faint", "huge"]), seeds, st.integers(1, 120))
def test_a_rigid_motion_of_scene_and_camera_does_not_matter(kind: str, seed: int, count: int) -> None:
    """Up to rounding (positions of the order of a metre in float32), and but for pixels at a cut."""
    scene, view = surfels(kind, count, seed), camera()
    here, there = render(scene, view), render(*moved(scene, view, seed))
    for name in ("rgb", "alpha", "normal"):
        error = (images(here)[name] - images(there)[name]).abs()
        assert float((error > 2e-3).float().mean()) <= 0.005, name
        assert float(error.max()) <= 0.02, name


@few
@given(kinds, seeds, st.integers(0, 60), st.integers(0, 42), st.integers(1, 40), st.integers(1, 40))
def test_a_crop_shows_the_same_pixels(kind: str, seed: int, x: int, y: int, width: int, height: int) -> None:
    scene, view = surfels(kind, 100, seed), camera()
    width, height = min(width, view.width - x), min(height, view.height - y)
    whole, part = render(scene, view), render(scene, view.crop(x, y, width, height))
    for name in ("rgb", "alpha", "normal"):
        error = (images(whole)[name][y : y + height, x : x + width] - images(part)[name]).abs()
        # Pixel coordinates are rounded relative to another corner; at a cut that can decide.
        assert int((error > 2e-3).sum()) <= max(3, 0.005 * error.numel()), name
        assert float(error.max()) <= 0.02, name


@pytest.mark.parametrize("name", instruction_sets()[:2])
@pytest.mark.parametrize("kind", ["overlapping", "huge", "twins"])
def test_any_number_of_threads_gives_the_same_bits(name: str, kind: str) -> None:
    scene, view = surfels(kind, 9000, 8), camera(150, 97)
    scene = replace(scene, tangents=scene.tangents * (1.0 if kind == "huge" else 0.2))
    results = []
    for threads in (1, 2, 3, 7, 2, 1):
        options = replace(EVERYTHING, threads=threads, instruction_set=name)  # type: ignore[arg-type]
        out, gradients = with_gradients(scene, view, options, torch.float32)
        results.append(
            {**images(out), "weight_sum": out.weight_sum, **{f"d_{k}": v for k, v in gradients.items()}}
        )
    for other in results[1:]:
        for key, value in results[0].items():
            assert torch.equal(value, other[key]), key
    assert float(results[0]["alpha"].detach().max()) > 0.5


def test_ties_in_depth_go_by_index() -> None:
    scene = surfels("twins", 2, 1)
    scene = replace(scene, opacities=torch.tensor([0.9, 0.9]), tangents=20 * scene.tangents)
    scene = replace(scene, colors=torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))
    rgb = render(scene, camera()).rgb
    assert bool((rgb[..., 0] >= rgb[..., 1]).all())
    assert float(rgb[..., 0].max()) > 0.5
