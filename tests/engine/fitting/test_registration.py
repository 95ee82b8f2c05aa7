"""Registration: the Jacobians against differences, and steps that find a known hand again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from mass_engine.fitting.gauss_newton import Registrar, Round, conjugate_gradients
from mass_engine.fitting.kinematics import pose_jacobian, shape_jacobian, turned
from mass_engine.fitting.light import LightSample, solve_light
from mass_engine.fitting.poses import PoseTable
from mass_engine.fitting.registration import signed_distance
from mass_engine.fitting.starts import difference
from mass_engine.fitting.subject import Shape, vertex_normals
from mass_engine.hand.builtin import load_builtin
from mass_engine.hand.pose import HandPose
from mass_engine.raster import RasterOptions
from mass_engine.surfel.binding import MeshBinding
from mass_engine.surfel.shading import irradiance_basis
from mass_engine.surfel.subdivision import loop_subdivision
from tests.engine.fitting.clips import CAMERA, joint_error, make_views, painted, true_poses


def bent(seed: int, count: int = 2) -> HandPose:
    random = torch.Generator().manual_seed(seed)
    return HandPose(
        0.5 * torch.randn(count, 10, generator=random),
        torch.randn(count, 3, generator=random),
        0.3 * torch.randn(count, 45, generator=random),
        torch.tensor([0.0, 0.0, 0.4]).repeat(count, 1),
    )


def test_pose_jacobian_is_the_derivative() -> None:
    model = replace(load_builtin("right"), pose_basis=None)  # correctives are left out of the derivative
    shape, subdivision = (
        Shape.mean(model, torch.zeros(10)),
        loop_subdivision(model.faces, len(model.template), 1),
    )
    pose, step = bent(1), 1e-3
    jacobian = pose_jacobian(shape, subdivision, pose)
    assert torch.allclose(jacobian.vertices, subdivision.apply(model.posed(pose).vertices), atol=1e-6)
    for number in range(51):
        small = torch.zeros(2, 51)
        small[:, number] = step
        ends = [subdivision.apply(model.posed(turned(pose, s)).vertices) for s in (small, -small)]
        numeric = (ends[0] - ends[1]) / (2 * step)
        for row in range(2):
            assert torch.allclose(jacobian.of(row)[..., number], numeric[row], atol=2e-4), number


def test_offsets_turn_with_the_skin() -> None:
    model = load_builtin("right")
    subdivision = loop_subdivision(model.faces, len(model.template), 0)
    shape, pose = Shape.mean(model, torch.zeros(10)), bent(2)
    turns = pose_jacobian(shape, subdivision, pose).turns
    offset = 1e-3 * torch.randn(len(model.template), 3, generator=torch.Generator().manual_seed(3))
    moved = model.posed(pose, offset).vertices - model.posed(pose).vertices
    assert torch.allclose(moved, (turns @ offset.unsqueeze(-1)).squeeze(-1), atol=1e-6)


def test_shape_jacobian_predicts_a_change_of_shape() -> None:
    model = load_builtin("right")
    subdivision = loop_subdivision(model.faces, len(model.template), 1)
    shape, pose = Shape.mean(model, torch.zeros(10)), bent(4)
    change = 0.1 * torch.randn(10, generator=torch.Generator().manual_seed(5))
    predicted = shape_jacobian(shape, subdivision, pose) @ change
    other = replace(pose, betas=pose.betas + change)
    moved = subdivision.apply(model.posed(other).vertices - model.posed(pose).vertices)
    assert float((predicted - moved).norm(dim=-1).max()) < 1e-5 + 0.02 * float(moved.norm(dim=-1).max())


def test_difference_undoes_a_turn() -> None:
    pose = bent(6)
    step = 0.2 * torch.randn(2, 51, generator=torch.Generator().manual_seed(7))
    assert torch.allclose(difference(pose, turned(pose, step)), step, atol=1e-5)


def test_signed_distance_of_a_half_plane() -> None:
    picture = np.zeros((20, 30), np.float32)
    picture[:, 12:] = 1.0
    distance = signed_distance(picture)
    columns = np.arange(30) + 0.5 - 12
    assert np.abs(distance[10] - columns).max() < 0.05 * 18 + 0.01
    assert (signed_distance(np.zeros((4, 4), np.float32)) < 0).all()


def test_conjugate_gradients_solve_a_system() -> None:
    random = torch.Generator().manual_seed(8)
    root = torch.randn(12, 12, generator=random)
    matrix = root @ root.T + torch.eye(12)
    right = torch.randn(12, 3, generator=random)
    found = conjugate_gradients(lambda x: matrix @ x, right, 80)
    assert torch.allclose(matrix @ found, right, atol=1e-3)


def test_light_is_found_again() -> None:
    random = torch.Generator().manual_seed(9)
    light = torch.zeros(9, 3)
    light[0], light[1], light[3] = 1.0, torch.tensor([0.25, 0.2, 0.15]), -0.2
    albedo = 0.3 + 0.5 * torch.rand(200, 3, generator=random)
    samples = []
    for _ in range(12):
        normal = torch.nn.functional.normalize(torch.randn(200, 3, generator=random), dim=-1)
        color = albedo * (irradiance_basis(normal) @ light)
        samples.append(LightSample(torch.arange(200), color, normal))
    assert float((solve_light(samples, 200, rounds=20, ridge=1e-4) - light).abs().max()) < 0.03


def perturbed(truth: HandPose, seed: int, angle: float) -> HandPose:
    random = torch.Generator().manual_seed(seed)
    step = angle * torch.randn(len(truth.transl), 51, generator=random)
    step[:, 48:] = 0.004 * torch.randn(len(truth.transl), 3, generator=random)
    return turned(truth, step)


def test_texture_and_outline_bring_poses_back() -> None:
    truth = true_poses(5)
    views = make_views(truth)
    start = perturbed(truth, 10, 0.05)
    model = load_builtin("right")
    binding = MeshBinding.build(model, 1, 1)
    table = PoseTable(start)
    registrar = Registrar(
        views, table, Shape.mean(model, torch.zeros(10)), CAMERA, RasterOptions(cull_backfaces=True)
    )
    look = painted(binding)
    rows = list(range(5))
    for side in (100, 200, 200, 200):
        registrar.step(Round(side, betas=False, offsets=False), binding, look, rows)
    before, after = joint_error(start, truth), joint_error(table.pose(torch.zeros(10)), truth)
    assert float(after.mean()) < 0.45 * float(before.mean())
    assert bool((after < before).all())


def test_outline_finds_a_thicker_hand() -> None:
    truth = true_poses(6)
    model = load_builtin("right")
    thick = replace(model, template=model.template + 0.0015 * vertex_normals(model.template, model.faces))
    views = make_views(truth, model=thick)
    binding = MeshBinding.build(model, 1, 0)
    shape = Shape.mean(model, torch.zeros(10))
    registrar = Registrar(views, PoseTable(truth), shape, CAMERA, RasterOptions(cull_backfaces=True))
    turn = Round(200, texture=False, betas=False)
    pulls = [registrar.step(turn, binding, painted(binding)) for _ in range(6)]
    along = (shape.displacement * vertex_normals(model.template, model.faces)).sum(-1)
    assert float(pulls[-1].mean()) < 0.5 * float(pulls[0].mean())
    assert float(along[along.abs() > 3e-4].mean()) > 3e-4  # outward; the rest was never on an outline
