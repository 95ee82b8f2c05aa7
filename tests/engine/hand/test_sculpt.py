"""The data file is what the code makes, and the tools that make it do what they say."""

from __future__ import annotations

import numpy as np
import pytest
from safetensors.numpy import load_file

from mass_engine.hand.anatomy import SHAPE_NAMES, Tissue, soft_tissue
from mass_engine.hand.builtin import DATA_FILE
from mass_engine.hand.field import distance_field, field_gradient, project, tissue_distance
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
