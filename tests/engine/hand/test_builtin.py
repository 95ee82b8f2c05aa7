"""The built-in hand: a sound mesh, a believable shape space, limits in an anatomical frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import cKDTree

from mass_engine.hand.anatomy import SHAPE_NAMES, SHAPE_RANGES, SHAPE_STEPS, skeleton
from mass_engine.hand.builtin import DATA_FILE, joint_frames, joint_limits, load_builtin
from mass_engine.hand.model import HandModel
from mass_engine.hand.pose import HandPose, Side
from mass_engine.surfel.subdivision import Subdivision, loop_subdivision

SIDES: tuple[Side, ...] = ("right", "left")


def mesh_of(model: HandModel, vertices: torch.Tensor | None = None) -> trimesh.Trimesh:
    points = model.template if vertices is None else vertices
    return trimesh.Trimesh(points.double().numpy(), model.faces.numpy(), process=False)


@pytest.mark.parametrize("side", SIDES)
def test_the_mesh_is_closed_manifold_and_faces_outward(side: Side) -> None:
    mesh = mesh_of(load_builtin(side))
    assert 800 <= len(mesh.vertices) <= 1600
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.euler_number == 2
    assert mesh.body_count == 1
    # An adult hand with a little wrist: outward winding makes the volume positive.
    assert 250e-6 < mesh.volume < 480e-6


def test_triangles_are_even() -> None:
    mesh = mesh_of(load_builtin("right"))
    edges = mesh.edges_unique_length
    assert edges.max() / edges.min() < 6
    assert np.degrees(mesh.face_angles.min()) > 20


def crossing_faces(vertices: np.ndarray, faces: np.ndarray) -> int:
    """Number of (edge, triangle) pairs that pierce each other, neighbours left out (Moeller and Trumbore)."""
    edges = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    origin, step = vertices[edges[:, 0]], vertices[edges[:, 1]] - vertices[edges[:, 0]]
    count = 0
    corners = vertices[faces]
    centers = corners.mean(1)
    # Only edges near enough to reach the face at all.
    reach = np.linalg.norm(corners - centers[:, None], axis=2).max(1) + np.linalg.norm(step, axis=1).max() / 2
    candidates = cKDTree(origin + step / 2).query_ball_point(centers, reach)
    for face, chosen in zip(faces, candidates, strict=True):
        a, b, c = vertices[face]
        near = np.array(chosen, int)
        near = near[(edges[near][..., None] != face).all((1, 2))]
        if not len(near):
            continue
        o, d = origin[near], step[near]
        h = np.cross(d, c - a)
        det = h @ (b - a)
        ok = np.abs(det) > 1e-18
        inverse = 1 / np.where(ok, det, 1)
        u = inverse * np.einsum("ij,ij->i", o - a, h)
        q = np.cross(o - a, b - a)
        v = inverse * np.einsum("ij,ij->i", d, q)
        t = inverse * (q @ (c - a))
        count += int((ok & (u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0) & (t <= 1)).sum())
    return count


def test_crossing_faces_finds_a_crossing() -> None:
    vertices = np.array([[0, 0, 0], [2, 0, 0], [0, 2, 0], [0.4, 0.4, -1], [0.4, 0.4, 1], [3, 3, 0.5]], float)
    assert crossing_faces(vertices, np.array([[0, 1, 2], [3, 4, 5]])) > 0
    assert (
        crossing_faces(
            vertices + np.array([[0, 0, 0]] * 3 + [[9, 0, 0]] * 3), np.array([[0, 1, 2], [3, 4, 5]])
        )
        == 0
    )


def test_no_self_intersection_at_rest_over_the_whole_range() -> None:
    model = load_builtin("right")
    faces = model.faces.numpy()
    assert crossing_faces(model.template.double().numpy(), faces) == 0
    for place, name in enumerate(SHAPE_NAMES):
        for value in SHAPE_RANGES[place]:
            betas = torch.zeros(10)
            betas[place] = value
            shaped = (model.template + model.shape_basis @ betas).double().numpy()
            assert crossing_faces(shaped, faces) == 0, (name, value)


def test_rest_frame_is_mano_like() -> None:
    points = load_builtin("right").joint_template
    assert points[0].abs().max() < 1e-6
    # Fingers along -x, thumb on the +z side, index to little finger from +z to -z.
    assert (points[17:, 0] < -0.1).all()
    assert points[16, 2] > points[17, 2] > points[18, 2] > points[19, 2] > points[20, 2]
    assert 0.16 < -float(points[18, 0]) < 0.21  # wrist to middle fingertip of an adult
    # Turning an index joint about +z bends the finger towards the palm (-y).
    fingers = torch.zeros(45)
    fingers[2] = 0.5
    zero = torch.zeros(3)
    bent = load_builtin("right").joints(HandPose(torch.zeros(10), zero, fingers, zero))
    assert bent[17, 1] < points[17, 1] - 0.02


def test_weights_are_convex_and_smooth() -> None:
    model = load_builtin("right")
    weights = model.weights
    assert (weights >= 0).all()
    assert torch.allclose(weights.sum(1), torch.ones(len(weights)), atol=1e-5)
    edges = torch.cat([model.faces[:, [0, 1]], model.faces[:, [1, 2]], model.faces[:, [2, 0]]])
    change = (weights[edges[:, 0]] - weights[edges[:, 1]]).abs().max()
    assert change < 0.62  # no jump from one bone to another across an edge
    # Every bone moves something, and each fingertip moves with its last bone alone.
    assert (weights.max(0).values > 0.7).all()
    for tip, bone in ((16, 15), (17, 3), (18, 6), (19, 12), (20, 9)):
        nearest = (model.template - model.joint_template[tip]).norm(dim=1).argmin()
        assert weights[nearest, bone] > 0.99


@pytest.mark.parametrize("joint", [1, 2, 3, 5, 8, 11, 14, 15])
def test_a_right_angle_keeps_the_back_of_the_joint_round(joint: int) -> None:
    """No candy wrapper: the skin on the back stays as far from the joint as at rest."""
    model = load_builtin("right")
    frame = joint_frames(model)[joint - 1]
    fingers = torch.zeros(15, 3)
    fingers[joint - 1] = frame[0] * (np.pi / 2)
    zero = torch.zeros(3)
    pose = HandPose(torch.zeros(10), zero, fingers.flatten(), zero)
    place = model.joint_template[joint]
    arm = model.template - place
    back, across = arm @ frame[1], arm @ frame[0]
    # Fingers have their back along the abduction axis; only skin right above the joint.
    above = (back > 0.6 * arm.norm(dim=1)) & (across.abs() < 0.006) & (arm.norm(dim=1) < 0.016)
    assert above.sum() >= 2
    bent, joints = model(pose)
    before, after = arm[above].norm(dim=1), (bent[above] - joints[joint]).norm(dim=1)
    assert float((after / before).min()) > 0.88
    without = HandModel.from_tensors("right", {k: v for k, v in model.tensors().items() if k != "pose_basis"})
    plain = (without(pose)[0][above] - joints[joint]).norm(dim=1)
    assert float((after / before).min()) > float((plain / before).min())


def refined_volume(model: HandModel, pose: HandPose, of: torch.Tensor, fine: Subdivision) -> float:
    """Volume (cubic metres) of the subdivided surface."""
    vertices, _ = model(pose)
    return float(trimesh.Trimesh(fine.apply(vertices).double().numpy(), of.numpy(), process=False).volume)


@pytest.mark.parametrize("joint", [2, 3, 5, 6, 8, 9, 11, 12, 15])
def test_a_right_angle_keeps_the_volume_of_the_joint(joint: int) -> None:
    """Of the flesh around the joint (a ball of one finger breadth) at most 15 % is lost or won."""
    model = load_builtin("right")
    fine = loop_subdivision(model.faces, len(model.template), 1)
    fingers = torch.zeros(15, 3)
    fingers[joint - 1] = joint_frames(model)[joint - 1, 0] * (np.pi / 2)
    pose = replace(HandPose.rest("right"), hand_pose=fingers.flatten())
    plain = replace(model, pose_basis=None)
    rest, plain_bent, bent = (
        refined_volume(*case, fine.faces, fine)
        for case in ((model, HandPose.rest("right")), (plain, pose), (model, pose))
    )
    around = 4 / 3 * np.pi * 0.010**3
    assert abs(bent - rest) < 0.15 * around
    assert abs(bent - rest) < 0.4 * abs(plain_bent - rest)


@pytest.mark.parametrize("joint", [1, 4, 10, 7, 2, 5, 8, 11])
def test_bending_shapes_vanish_at_rest_and_grow_without_jumps(joint: int) -> None:
    model = load_builtin("right")
    axis = joint_frames(model)[joint - 1, 0]
    plain = replace(model, pose_basis=None)
    before = torch.zeros(())
    for degrees in range(0, 111, 10):
        fingers = torch.zeros(15, 3)
        fingers[joint - 1] = axis * np.radians(degrees)
        pose = replace(HandPose.rest("right"), hand_pose=fingers.flatten())
        added = (model(pose)[0] - plain(pose)[0]).norm(dim=1).max()
        if degrees == 0:
            assert float(added) < 1e-7
        assert float(added - before) < 0.0025
        before = added
    assert 0.001 < float(before) < 0.012


@pytest.mark.parametrize(("joint", "tip"), [(3, 17), (6, 18), (12, 19), (9, 20), (15, 16)])
def test_nails_are_raised_plates(joint: int, tip: int) -> None:
    """Along the middle of a digit's back the nail stands over the line from behind it to its free end."""
    model = load_builtin("right")
    fine = loop_subdivision(model.faces, len(model.template), 3)
    arm = (fine.apply(model.template) - model.joint_template[tip]) @ joint_frames(model)[joint - 1].T
    arm = arm[(arm[:, 0].abs() < 0.0012) & (arm[:, 1] > 0) & (arm.norm(dim=1) < 0.024)] * 1e3
    places = torch.arange(-21.0, -3.0)
    near = [(arm[:, 2] - place).abs() < 0.6 for place in places]
    heights = torch.stack([arm[here, 1].mean() for here in near])
    line = torch.lerp(heights[0], heights[-1], torch.linspace(0, 1, len(places)))
    assert float((heights - line).max()) > 0.2  # millimetres; without nails less than 0.1


def girths(vertices: np.ndarray) -> dict[str, float]:
    """Some outer measures (metres) of a resting hand's vertices."""
    x, y, z = vertices.T
    size = -x.min() / 0.188
    knuckles = (np.abs(x + 0.085 * size) < 0.006 * size) & (z < 0.045 * size)
    middle = (np.abs(x + 0.060 * size) < 0.008 * size) & (np.abs(z) < 0.006 * size)
    return {
        "length": -float(x.min()),
        "breadth": float(np.ptp(z[knuckles])),
        "thickness": float(np.ptp(y[middle])),
    }


def test_the_mean_hand_is_average() -> None:
    """Between the means of women and men (Garrett 1971, Greiner 1991)."""
    mean = girths(load_builtin("right").template.double().numpy())
    assert 0.180 < mean["length"] < 0.194
    assert 0.078 < mean["breadth"] < 0.090
    assert 0.026 < mean["thickness"] < 0.034


def test_the_size_covers_children_and_tall_adults() -> None:
    """Hand length from about six years of age (0.13 m) to beyond the 99th percentile of men (0.215 m)."""
    model = load_builtin("right")
    lengths = []
    for value in SHAPE_RANGES[0]:
        betas = torch.zeros(10)
        betas[0] = value
        lengths.append(girths((model.template + model.shape_basis @ betas).double().numpy())["length"])
    assert lengths[0] < 0.13
    assert lengths[1] > 0.215
    for low, high in SHAPE_RANGES:
        assert low < 0 < high


def test_shape_parameters_do_what_their_names_say() -> None:
    model = load_builtin("right")
    rest = model.joint_template

    def change(name: str) -> tuple[torch.Tensor, torch.Tensor]:
        place = SHAPE_NAMES.index(name)
        return model.template + model.shape_basis[..., place], rest + model.joint_shape_basis[..., place]

    def length(points: torch.Tensor, *chain: int) -> float:
        return float((points[list(chain[1:])] - points[list(chain[:-1])]).norm(dim=1).sum())

    steps = dict(zip(SHAPE_NAMES, SHAPE_STEPS, strict=True))
    vertices, joints = change("size")
    assert torch.allclose(joints, rest * (1 + steps["size"]), atol=1e-6)
    assert torch.allclose(vertices, model.template * (1 + steps["size"]), atol=1e-6)
    for name, chain in {
        "finger_length": (4, 5, 6, 18),
        "thumb_length": (13, 14, 15, 16),
        "index_length": (1, 2, 3, 17),
        "pinky_length": (7, 8, 9, 20),
    }.items():
        _, joints = change(name)
        assert length(joints, *chain) == pytest.approx(length(rest, *chain) * (1 + steps[name]), rel=1e-4), (
            name
        )
    assert torch.equal(change("index_length")[1][18], rest[18])
    for name in ("finger_thickness", "palm_thickness", "wrist_thickness"):
        assert torch.equal(change(name)[1], rest), name
        assert mesh_of(model, change(name)[0]).volume > mesh_of(model).volume
    _, joints = change("palm_width")
    assert joints[1, 2] - joints[7, 2] == pytest.approx(float(rest[1, 2] - rest[7, 2]) * 1.05, rel=1e-4)


def test_joints_follow_the_skeleton_over_the_whole_range() -> None:
    model = load_builtin("right")
    for place, (low, high) in enumerate(SHAPE_RANGES):
        for value in (low, high):
            betas = np.zeros(10)
            betas[place] = value
            linear = model.joint_template + model.joint_shape_basis @ torch.tensor(betas, dtype=torch.float32)
            assert np.abs(linear.numpy() - skeleton(betas)).max() < 1e-6


@pytest.mark.parametrize("side", SIDES)
def test_joint_frames_are_rotations_and_mean_the_same_on_both_sides(side: Side) -> None:
    model = load_builtin(side)
    frames = joint_frames(model)
    assert torch.allclose(frames @ frames.mT, torch.eye(3).expand(15, 3, 3), atol=1e-5)
    assert torch.allclose(torch.linalg.det(frames), torch.ones(15), atol=1e-5)
    zero = torch.zeros(3)
    tips = {1: 17, 4: 18, 7: 20, 10: 19}
    for joint, tip in tips.items():
        for row, axis, sign in (
            (0, 1, -1),
            (1, 2, 1),
        ):  # flexion lowers the tip, abduction moves it to the thumb
            fingers = torch.zeros(15, 3)
            fingers[joint - 1] = frames[joint - 1, row] * 0.3
            moved = model.joints(HandPose(torch.zeros(10), zero, fingers.flatten(), zero, side))
            assert sign * float(moved[tip, axis] - model.joint_template[tip, axis]) > 0.01
    # Bending the thumb brings its tip nearer to the little finger's knuckle.
    fingers = torch.zeros(15, 3)
    fingers[13:] = frames[13:, 0] * 0.5
    moved = model.joints(HandPose(torch.zeros(10), zero, fingers.flatten(), zero, side))
    assert (moved[16] - moved[7]).norm() < (model.joint_template[16] - model.joint_template[7]).norm() - 0.01


def test_limits_hold_the_rest_pose_and_are_ordered() -> None:
    limits = joint_limits()
    assert limits.shape == (15, 3, 2)
    assert (limits[..., 0] < 0).all()
    assert (limits[..., 1] > 0).all()
    assert limits.abs().max() < np.pi


def test_the_data_file_is_small() -> None:
    assert DATA_FILE.stat().st_size < 1_500_000
