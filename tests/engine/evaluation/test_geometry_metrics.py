"""Silhouettes, outlines and surfaces against values known by hand."""

from __future__ import annotations

import math

import numpy as np
import torch
import trimesh
from scipy.spatial.transform import Rotation

from mass_engine.evaluation.outlines import boundary_f, iou, signed_distance
from mass_engine.evaluation.surfaces import depth_error, normal_error, similarity, surface_distance


def disk(radius: float, x: float = 50.0) -> torch.Tensor:
    rows, columns = torch.meshgrid(torch.arange(100.0), torch.arange(100.0), indexing="ij")
    return ((rows - 50).square() + (columns - x).square()).sqrt() < radius


def test_iou_counts_valid_pixels_only() -> None:
    a = torch.tensor([[True, True, False, False]])
    b = torch.tensor([[True, False, True, False]])
    assert iou(a, b) == 1 / 3
    assert iou(a, b, torch.tensor([[True, False, False, True]])) == 1.0
    assert iou(~a & a, ~b & b) == 1.0


def test_boundary_f_counts_outlines_within_reach() -> None:
    assert boundary_f(disk(20), disk(20), 1.0) == 1.0
    assert boundary_f(disk(20), disk(21), 1.5) == 1.0
    assert boundary_f(disk(20), disk(25), 2.0) == 0.0
    half = boundary_f(disk(20), disk(20, 53.0), 1.5)
    assert 0.1 < half < 0.7
    # What is ignored has no outline.
    valid = torch.ones(100, 100, dtype=torch.bool)
    valid[:, 50:] = False
    shifted = disk(20) | (disk(20, 60.0) & ~valid)
    assert boundary_f(shifted, disk(20), 1.0, valid) == 1.0
    empty = torch.zeros(100, 100, dtype=torch.bool)
    assert boundary_f(empty, empty, 1.0) == 1.0
    assert boundary_f(empty, disk(20), 1.0) == 0.0
    assert np.isinf(signed_distance(empty.numpy())).all()


def test_surface_distance_agrees_with_trimesh() -> None:
    sphere = trimesh.creation.icosphere(subdivisions=3, radius=0.05)
    points = np.random.default_rng(0).normal(0, 0.05, (300, 3))
    _, expected, _ = trimesh.proximity.closest_point_naive(sphere, points)
    ours = surface_distance(points, np.array(sphere.vertices), np.array(sphere.faces, np.int64), near=64)
    np.testing.assert_allclose(ours, expected, atol=1e-9)


def test_similarity_finds_scale_turn_and_shift() -> None:
    random = np.random.default_rng(1)
    points = random.normal(size=(21, 3))
    turn = Rotation.from_rotvec([0.3, 0.6, 0.9]).as_matrix()
    scale, rotation, shift = similarity(points, 0.7 * points @ turn.T + [1, 2, 3])
    assert abs(scale - 0.7) < 1e-9
    np.testing.assert_allclose(rotation, turn, atol=1e-9)
    np.testing.assert_allclose(shift, [1, 2, 3], atol=1e-9)


def test_depth_and_normals() -> None:
    mask = torch.tensor([[True, True, False]])
    assert abs(depth_error(torch.tensor([[1.0, 2.0, 9.0]]), torch.tensor([[1.1, 2.3, 0]]), mask) - 0.2) < 1e-6
    z = torch.tensor([0.0, 0.0, 2.0])
    tilted = torch.tensor([0.0, math.sin(0.2), math.cos(0.2)])
    found = normal_error(torch.stack([z, z, -z])[None], torch.stack([z, tilted, z])[None], mask)
    assert abs(found - math.degrees(0.1)) < 1e-4
    nothing = torch.zeros_like(mask)
    assert math.isnan(depth_error(torch.ones(1, 3), torch.ones(1, 3), nothing))
    assert math.isnan(normal_error(torch.ones(1, 3, 3), torch.ones(1, 3, 3), nothing))
