"""Skinning, shape blend and rotations of the hand model."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch import Tensor

from mass_engine.errors import EngineError
from mass_engine.hand.builtin import load_builtin
from mass_engine.hand.model import HandModel, axis_angle_to_matrix, mirror_pose
from mass_engine.hand.pose import JOINT_PARENTS, TIP_PARENTS, HandPose

few = settings(max_examples=8, deadline=None, derandomize=True)
seeds = st.integers(0, 10_000)


@pytest.fixture(scope="module")
def model() -> HandModel:
    return load_builtin("right")


def random_pose(seed: int, *lead: int, strength: float = 0.6) -> HandPose:
    random = torch.Generator().manual_seed(seed)

    def draw(size: int, scale: float) -> Tensor:
        return torch.randn(*lead, size, generator=random) * scale

    return HandPose(draw(10, 1.0), draw(3, 1.0), draw(45, strength), draw(3, 0.2))


@few
@given(seeds)
def test_rotations_agree_with_scipy(seed: int) -> None:
    vectors = torch.randn(50, 3, generator=torch.Generator().manual_seed(seed)) * 2
    expected = torch.tensor(Rotation.from_rotvec(vectors.numpy()).as_matrix(), dtype=torch.float32)
    assert torch.allclose(axis_angle_to_matrix(vectors), expected, atol=2e-6)


@pytest.mark.parametrize("size", [0.0, 1e-20, 1e-6, 9.9e-4, 1.1e-3, 1.0, 3.14159, 6.28])
def test_rotation_gradient_is_finite_and_right_at_every_angle(size: float) -> None:
    vector = torch.tensor([0.6, -0.64, 0.48], dtype=torch.float64) * size
    vector.requires_grad_(True)
    assert torch.autograd.gradcheck(axis_angle_to_matrix, (vector,), eps=1e-5, atol=1e-6)
    single = vector.detach().float().requires_grad_(True)
    axis_angle_to_matrix(single)[0, 1].backward()
    assert single.grad is not None
    assert torch.isfinite(single.grad).all()


def test_rest_pose_gives_the_template(model: HandModel) -> None:
    vertices, joints = model(HandPose.rest("right"))
    assert torch.allclose(vertices, model.template, atol=1e-7)
    assert torch.allclose(joints, model.joint_template, atol=1e-7)


@few
@given(seeds)
def test_skinning_agrees_with_a_plain_walk_over_the_bones(seed: int) -> None:
    model = load_builtin("right").to("cpu", torch.float64)
    pose32 = random_pose(seed)
    pose = HandPose(
        pose32.betas.double(),
        pose32.global_orient.double(),
        pose32.hand_pose.double(),
        pose32.transl.double(),
    )
    rest = model.joint_template + model.joint_shape_basis @ pose.betas
    vectors = torch.cat([pose.global_orient, pose.hand_pose]).reshape(16, 3)
    local = torch.tensor(Rotation.from_rotvec(vectors.numpy()).as_matrix())
    shaped = model.template + model.shape_basis @ pose.betas
    assert model.pose_basis is not None
    shaped = shaped + model.pose_basis @ (local[1:] - torch.eye(3)).reshape(135)
    world: list[Tensor] = []
    for joint, parent in enumerate(JOINT_PARENTS):
        here = torch.eye(4, dtype=torch.float64)
        here[:3, :3] = local[joint]
        here[:3, 3] = rest[joint] - (rest[parent] if parent >= 0 else 0)
        world.append(world[parent] @ here if parent >= 0 else here)
    expected = torch.zeros_like(shaped)
    for joint in range(16):
        moved = (shaped - rest[joint]) @ world[joint][:3, :3].T + world[joint][:3, 3]
        expected += model.weights[:, [joint]] * moved
    tips = torch.stack(
        [world[p][:3, :3] @ (rest[16 + t] - rest[p]) + world[p][:3, 3] for t, p in enumerate(TIP_PARENTS)]
    )
    points = torch.cat([torch.stack([w[:3, 3] for w in world]), tips])
    vertices, joints = model(pose)
    # The stored weights sum to one in single precision only.
    assert torch.allclose(vertices, expected + pose.transl, atol=1e-7)
    assert torch.allclose(joints, points + pose.transl, atol=1e-9)


def test_batches_broadcast_and_equal_single_poses(model: HandModel) -> None:
    batch = random_pose(3, 4, 2)
    shared = replace(batch, betas=batch.betas[0, 0])
    vertices, joints = model(shared)
    assert vertices.shape == (4, 2, len(model.template), 3)
    assert joints.shape == (4, 2, 21, 3)
    one = HandPose(shared.betas, batch.global_orient[2, 1], batch.hand_pose[2, 1], batch.transl[2, 1])
    assert torch.allclose(vertices[2, 1], model(one)[0], atol=1e-6)
    assert torch.allclose(model.joints(shared), joints, atol=1e-7)


@few
@given(seeds)
def test_global_orient_turns_about_the_wrist_then_transl_moves(seed: int) -> None:
    model, pose = load_builtin("right"), random_pose(seed)
    still = replace(pose, global_orient=torch.zeros(3), transl=torch.zeros(3))
    vertices, joints = model(still)
    turn = axis_angle_to_matrix(pose.global_orient)
    expected = (vertices - joints[0]) @ turn.T + joints[0] + pose.transl
    assert torch.allclose(model(pose)[0], expected, atol=1e-6)


@few
@given(seeds)
def test_bone_transforms_carry_the_rest_joints(seed: int) -> None:
    model, pose = load_builtin("right"), random_pose(seed)
    posed = model.posed(pose)
    rest = model.joints(replace(HandPose.rest("right"), betas=pose.betas))
    carried = torch.einsum("jab,jb->ja", posed.bone_transforms[:, :3, :3], rest[:16])
    assert torch.allclose(carried + posed.bone_transforms[:, :3, 3], posed.joints[:16], atol=1e-6)


def test_offsets_are_added_before_skinning(model: HandModel) -> None:
    pose = random_pose(5)
    offsets = torch.randn(len(model.template), 3, generator=torch.Generator().manual_seed(1)) * 1e-3
    moved = replace(model, template=model.template + offsets)
    assert torch.allclose(model.posed(pose, offsets).vertices, moved(pose)[0], atol=1e-6)


@few
@given(seeds)
def test_shape_is_exactly_linear_in_vertices_and_joints(seed: int) -> None:
    model = load_builtin("right").to("cpu", torch.float64)
    a, b = torch.randn(2, 10, generator=torch.Generator().manual_seed(seed)).double()
    zero = torch.zeros(3, dtype=torch.float64)

    def at(betas: Tensor) -> tuple[Tensor, Tensor]:
        return model(HandPose(betas, zero, torch.zeros(45, dtype=torch.float64), zero))

    for of_a, of_b, mean, of_sum in zip(at(a), at(b), at(torch.zeros_like(a)), at(a + b), strict=True):
        assert torch.allclose(of_a + of_b - mean, of_sum, atol=1e-12)


def test_gradients_agree_with_finite_differences(model: HandModel) -> None:
    # Few vertices, double precision: every input of the pose at once.
    chosen = torch.arange(0, len(model.template), 97)
    assert model.pose_basis is not None
    small = replace(
        model,
        template=model.template[chosen],
        shape_basis=model.shape_basis[chosen],
        weights=model.weights[chosen],
        pose_basis=model.pose_basis[chosen],
    ).to("cpu", torch.float64)
    pose = random_pose(11)
    inputs = [
        value.double().requires_grad_(True)
        for value in (pose.betas, pose.global_orient, pose.hand_pose, pose.transl)
    ]
    assert torch.autograd.gradcheck(lambda *parts: small(HandPose(*parts)), inputs, atol=1e-6)


def test_gradient_at_rest_is_finite(model: HandModel) -> None:
    pose = HandPose.rest("right")
    leaves = [
        value.clone().requires_grad_(True)
        for value in (pose.betas, pose.global_orient, pose.hand_pose, pose.transl)
    ]
    vertices, joints = model(HandPose(leaves[0], leaves[1], leaves[2], leaves[3]))
    (vertices.square().sum() + joints.sum()).backward()
    for leaf in leaves:
        assert leaf.grad is not None
        assert torch.isfinite(leaf.grad).all()
        assert leaf.grad.abs().max() > 0


@few
@given(seeds)
def test_the_left_hand_is_the_mirror_image(seed: int) -> None:
    right, left = load_builtin("right"), load_builtin("left")
    pose = random_pose(seed)
    flip = torch.tensor([-1.0, 1.0, 1.0])
    mirrored = HandPose(
        pose.betas, mirror_pose(pose.global_orient), mirror_pose(pose.hand_pose), pose.transl * flip, "left"
    )
    for a, b in zip(right(pose), left(mirrored), strict=True):
        assert torch.allclose(a * flip, b, atol=2e-6)


def test_mirroring_twice_changes_nothing(model: HandModel) -> None:
    twice = model.mirrored().mirrored()
    assert twice.side == "right"
    for name, value in model.tensors().items():
        assert torch.equal(twice.tensors()[name], value), name


def test_tensors_round_trip(model: HandModel) -> None:
    again = HandModel.from_tensors("right", model.tensors())
    pose = random_pose(2)
    assert torch.equal(again(pose)[0], model(pose)[0])
    with pytest.raises(KeyError, match="weights"):
        HandModel.from_tensors("right", {k: v for k, v in model.tensors().items() if k != "weights"})


@pytest.mark.parametrize(
    ("field", "size"), [("betas", 9), ("hand_pose", 48), ("transl", 2), ("global_orient", 4)]
)
def test_a_pose_of_the_wrong_size_is_refused(model: HandModel, field: str, size: int) -> None:
    bad = replace(HandPose.rest("right"), **{field: torch.zeros(size)})  # type: ignore[arg-type]
    with pytest.raises(EngineError, match=field) as caught:
        model(bad)
    assert caught.value.code == "pose.shape"


def test_a_pose_of_the_other_side_is_refused(model: HandModel) -> None:
    with pytest.raises(EngineError) as caught:
        model.joints(HandPose.rest("left"))
    assert caught.value.code == "pose.side"
