"""The data file is what the code makes, and the tools that make it do what they say."""

from __future__ import annotations

import numpy as np
import pytest
from safetensors.numpy import load_file

from mass_engine.hand.anatomy import DIGITS, SHAPE_NAMES, Nail, Tissue, soft_tissue
from mass_engine.hand.builtin import DATA_FILE
from mass_engine.hand.field import (
    distance_field,
    field_gradient,
    nail_distance,
    nail_relief,
    project,
    tissue_distance,
    to_outline,
)
from mass_engine.hand.remesh import edge_faces, remesh
from mass_engine.hand.sculpt import sculpt

MEAN = np.zeros(len(SHAPE_NAMES))


def test_sculpting_again_makes_the_same_file() -> None:
    made, kept = sculpt(), load_file(DATA_FILE)
    assert made.keys() == kept.keys()
    assert np.array_equal(made["faces"], kept["faces"])
    for name, array in made.items():
        assert array.dtype == kept[name].dtype, name
        assert np.abs(array.astype(float) - kept[name].astype(float)).max() < 2e-5, name


def test_a_round_tissue_is_a_capsule() -> None:
    line = np.array([[0.0, 0.0, 0.0], [0.05, 0.0, 0.0]])
    tissue = Tissue("palm", line, np.full((2, 3), 0.01), np.array([0.0, 1.0, 0.0]), 0.01, 0.01)
    random = np.random.default_rng(0)
    points = random.uniform((-0.03, -0.03, -0.03), (0.08, 0.03, 0.03), (500, 3))
    on_line = np.clip(points[:, :1], 0, 0.05) * np.array([1.0, 0, 0])
    expected = np.linalg.norm(points - on_line, axis=1) - 0.01
    assert np.abs(tissue_distance(points, tissue) - expected).max() < 1e-9


def test_the_field_is_smooth_and_nearly_a_distance_at_the_surface() -> None:
    tissues = soft_tissue(MEAN)
    random = np.random.default_rng(1)
    points = random.uniform((-0.18, -0.02, -0.05), (0.02, 0.02, 0.05), (400, 3))
    surface = project(points, tissues, steps=12)
    reached = np.abs(distance_field(surface, tissues)) < 1e-5
    assert reached.mean() > 0.9
    slope = np.linalg.norm(field_gradient(surface[reached], tissues), axis=1)
    assert np.percentile(slope, 5) > 0.6
    assert np.percentile(slope, 95) < 1.5


def test_remeshing_a_coarse_ball_evens_its_triangles() -> None:
    trimesh = pytest.importorskip("trimesh")
    ball = trimesh.creation.uv_sphere(radius=0.02, count=[10, 24])

    def onto(points: np.ndarray) -> np.ndarray:
        return np.asarray(0.02 * points / np.linalg.norm(points, axis=1, keepdims=True))

    vertices, faces = remesh(
        np.array(ball.vertices), np.array(ball.faces), lambda p: np.full(len(p), 0.004), onto, rounds=6
    )
    even = trimesh.Trimesh(vertices, faces, process=False)
    assert even.is_watertight
    assert even.is_winding_consistent
    assert even.volume > 0
    assert even.euler_number == 2
    edges = even.edges_unique_length
    assert edges.max() / edges.min() < 2.5
    assert abs(np.median(edges) - 0.004) < 0.0006
    assert all(len(sides) == 2 for sides in edge_faces(faces).values())


def nail_of(digit: str) -> tuple[Nail, np.ndarray]:
    """A digit's nail and the direction out of it."""
    nail = next(part.nail for part in soft_tissue(MEAN) if part.group == digit)
    assert nail is not None
    return nail, np.cross(nail.across, nail.along)


@pytest.mark.parametrize("digit", DIGITS)
def test_a_nail_rises_over_the_back_of_the_tip_only(digit: str) -> None:
    nail, up = nail_of(digit)
    on_top = nail.middle + 0.006 * up
    assert nail_relief(on_top[None], nail)[0] == pytest.approx(nail.height, rel=0.05)
    below = nail.middle - 0.006 * up
    beyond = on_top + 2.5 * nail.length * nail.along
    assert np.abs(nail_relief(np.stack([below, beyond]), nail)).max() < 0.02 * nail.height
    # The fold at its root is a hollow.
    place = np.linspace(1.0, 1.6, 50)[:, None]
    assert nail_relief(on_top - place * nail.length * nail.along, nail).min() < -0.05 * nail.height
    assert nail_distance(on_top[None], nail)[0] == 0
    assert nail_distance(below[None], nail)[0] > 0.01


def test_points_near_a_nails_outline_are_put_onto_it() -> None:
    nail, up = nail_of("thumb")
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    flat = np.stack([np.cos(angle) * nail.length, np.sin(angle) * nail.breadth], 1)
    flat /= (np.cos(angle) ** 4 + np.sin(angle) ** 4)[:, None] ** 0.25
    outline = nail.middle + 0.006 * up + flat @ np.stack([nail.along, nail.across])
    near = outline + 0.05 * (outline - nail.middle - 0.006 * up)
    assert np.abs(to_outline(near, nail) - outline).max() < 1e-9
    far = outline + 0.6 * (outline - nail.middle - 0.006 * up)
    assert np.array_equal(to_outline(far, nail), far)


def test_round_ends_may_differ() -> None:
    line = np.array([[0.0, 0.0, 0.0], [0.05, 0.0, 0.0]])
    up = np.array([0.0, 1.0, 0.0])
    tissue = Tissue("palm", line, np.full((2, 3), 0.01), up, 0.01, 0.01, root=0.004)
    ends = np.array([[-0.004, 0, 0], [0.06, 0, 0]])
    assert np.abs(tissue_distance(ends, tissue)).max() < 1e-9
