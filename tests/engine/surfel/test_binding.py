"""Densification, and the fixed map from a posed mesh to its surfels."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mass_engine.hand.builtin import load_builtin
from mass_engine.hand.pose import HandPose
from mass_engine.hand.poses import named_pose
from mass_engine.surfel.binding import AttachedSurfels, MeshBinding
from mass_engine.surfel.densify import SURFELS_PER_FACE, fractal_corners
from mass_engine.surfel.inellipse import SIGMA_PER_SEMI_AXIS, quat_to_matrix, steiner_inellipse

few = settings(max_examples=5, deadline=None, derandomize=True)


def test_the_papers_counts() -> None:
    # 1538 faces, two Loop levels, centre and three corners, attached and detached.
    faces = 1538 * 4**2
    assert faces == 24_608
    assert faces * SURFELS_PER_FACE[1] * 2 == 196_864
    assert [len(fractal_corners(depth)) for depth in range(3)] == [1, 4, 13] == list(SURFELS_PER_FACE)


def test_small_triangles_are_sierpinskis() -> None:
    corners = fractal_corners(2)
    # Barycentric: every row sums to one and lies inside the face.
    assert torch.allclose(corners.sum(-1), torch.ones(13, 3))
    assert (corners >= 0).all()
    # The full face, then half-size, then quarter-size copies: areas are squared determinants.
    areas = torch.linalg.det(corners).abs()
    assert torch.allclose(areas, torch.tensor([1.0] + [1 / 4] * 3 + [1 / 16] * 9))
    # Each half-size copy keeps one corner of the face, each quarter-size copy one of a half-size copy.
    for k in range(3):
        assert torch.equal(corners[1 + k, k], torch.eye(3)[k])
    parents = corners[1:4].reshape(9, 3)
    for small in corners[4:]:
        assert any(torch.allclose(corner, parent) for corner in small for parent in parents)


def test_the_corner_ellipses_do_not_overlap_each_other() -> None:
    face = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0.5, math.sqrt(3) / 2, 0]])
    small = fractal_corners(1)[1:] @ face
    centers, scales, _ = steiner_inellipse(small)
    gaps = torch.pdist(centers)
    assert (gaps > 2 * scales.max() - 1e-6).all()


@pytest.mark.parametrize(("levels", "depth"), [(0, 0), (1, 1), (2, 0), (1, 2)])
def test_surfels_are_the_inellipses_of_the_small_triangles(levels: int, depth: int) -> None:
    model = load_builtin("right")
    binding = MeshBinding.build(model, levels, depth)
    vertices, _ = model(named_pose("pinch", "right"))
    surfels = binding.surfels(vertices)
    assert binding.count == len(model.faces) * 4**levels * SURFELS_PER_FACE[depth] == len(surfels.means)
    fine = binding.subdivision.apply(vertices)[binding.subdivision.faces]
    small = (fractal_corners(depth) @ fine.unsqueeze(1)).flatten(0, 1)
    centers, semi_axes, quats = steiner_inellipse(small)
    scales, mine = surfels.scales_quats()
    assert torch.allclose(surfels.means, centers, atol=1e-6)
    assert torch.allclose(scales, semi_axes * SIGMA_PER_SEMI_AXIS, rtol=2e-3, atol=1e-7)
    # Compare what the surfel draws: nearly round ellipses have no axes to speak of.
    axes = [quat_to_matrix(q)[..., :2] * s.unsqueeze(-2) for q, s in ((mine, scales), (quats, semi_axes))]
    one, two = (a @ a.mT for a in (axes[0], axes[1] * SIGMA_PER_SEMI_AXIS))
    assert float((one - two).abs().max() / two.abs().max()) < 1e-3
    assert torch.allclose(quat_to_matrix(mine)[..., 2], surfels.normals, atol=2e-3)


@pytest.mark.parametrize("depth", [0, 1, 2])
def test_scales_and_quats_by_face_are_those_of_each_surfel(depth: int) -> None:
    model = load_builtin("right")
    surfels = MeshBinding.build(model, 1, depth).surfels(model(named_pose("fist", "right"))[0])
    every = AttachedSurfels(surfels.means, surfels.tangents, surfels.normals)
    (scales, quats), (one_by_one, turns) = surfels.scales_quats(), every.scales_quats()
    assert torch.allclose(scales, one_by_one, rtol=1e-3, atol=1e-7)
    shapes = [quat_to_matrix(q)[..., :2] * s.unsqueeze(-2) for q, s in ((quats, scales), (turns, one_by_one))]
    one, two = (shape @ shape.mT for shape in shapes)
    assert float((one - two).abs().max() / two.abs().max()) < 1e-3


def test_normals_face_outward_and_faces_are_known() -> None:
    model = load_builtin("right")
    binding = MeshBinding.build(model, 1, 1)
    surfels = binding.surfels(model.template)
    corners = model.template[model.faces[binding.surfel_faces]]
    coarse = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    coarse = torch.nn.functional.normalize(coarse, dim=1)
    assert ((coarse * surfels.normals).sum(1) > 0.3).float().mean() > 0.999
    # A surfel lies by the face it says it belongs to.
    reach = (corners - corners.mean(1, keepdim=True)).norm(dim=-1).max(1).values
    assert ((surfels.means - corners.mean(1)).norm(dim=1) < 1.2 * reach + 1e-3).all()
    # And moves with the bone of that place: index fingertip surfels follow the last index bone.
    tip = (surfels.means - model.joint_template[17]).norm(dim=1).argmin()
    assert binding.bones[tip] == 3


def test_left_surfels_mirror_right_ones() -> None:
    flip = torch.tensor([-1.0, 1.0, 1.0])
    right, left = (load_builtin(side) for side in ("right", "left"))
    one = MeshBinding.build(right, 1, 0).surfels(right.template)
    two = MeshBinding.build(left, 1, 0).surfels(left.template)
    # Turning the faces round reorders the surfels within a face.
    apart, match = torch.cdist((one.means * flip).double(), two.means.double()).min(1)
    assert len(set(match.tolist())) == len(match)
    assert apart.max() < 1e-5
    assert torch.allclose(one.normals * flip, two.normals[match], atol=1e-4)


@few
@given(st.integers(0, 1000))
def test_surfels_move_rigidly_with_the_hand(seed: int) -> None:
    model = load_builtin("right")
    binding = MeshBinding.build(model, 1, 1)
    random = torch.Generator().manual_seed(seed)
    orient, shift = torch.randn(3, generator=random) * 2, torch.randn(3, generator=random)
    vertices = model.template
    turn = model.posed(HandPose(torch.zeros(10), orient, torch.zeros(45), torch.zeros(3)))
    rotation = turn.bone_transforms[0, :3, :3]
    one, two = binding.surfels(vertices), binding.surfels(vertices @ rotation.T + shift)
    assert torch.allclose(one.means @ rotation.T + shift, two.means, atol=1e-5)
    assert torch.allclose(one.scales_quats()[0], two.scales_quats()[0], atol=2e-6)
    assert torch.allclose(one.normals @ rotation.T, two.normals, atol=5e-3)


def test_batches_and_gradient_to_the_pose() -> None:
    model = load_builtin("right")
    binding = MeshBinding.build(model, 1, 1)
    fingers = torch.zeros(2, 45, requires_grad=True)
    pose = HandPose(torch.zeros(10), torch.zeros(2, 3), fingers, torch.zeros(2, 3))
    vertices, _ = model(pose)
    surfels = binding.surfels(vertices)
    assert surfels.means.shape == (2, binding.count, 3)
    scales, quats = surfels.scales_quats()
    assert scales.shape == (2, binding.count, 2)
    (surfels.means.sum() + scales.sum() + quats.sum()).backward()
    assert fingers.grad is not None
    assert torch.isfinite(fingers.grad).all()
    assert fingers.grad.abs().max() > 0
    single = binding.surfels(vertices[1].detach())
    assert torch.allclose(single.means, surfels.means[1], atol=1e-7)


@pytest.mark.parametrize("depth", [-1, 3])
def test_a_depth_out_of_range_is_refused(depth: int) -> None:
    with pytest.raises(ValueError, match="0 to 2"):
        fractal_corners(depth)
