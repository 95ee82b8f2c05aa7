"""MANO files: what is read agrees with the published formulas, computed here from the raw arrays."""

from __future__ import annotations

import io
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mass_engine.errors import EngineError
from mass_engine.hand.mano import TIP_VERTICES, main, read_mano
from mass_engine.hand.model import mirror_pose
from mass_engine.hand.pose import JOINT_PARENTS, HandPose
from tests.engine.hand.files import Array, left_arrays, mano_arrays, write_mano


def formulas(arrays: dict[str, Any], betas: Array, pose: Array, transl: Array) -> tuple[Array, Array]:
    """Vertices and 16 joints (Romero et al. 2017, equations 1 to 4) from the arrays alone."""
    shaped = arrays["v_template"] + arrays["shapedirs"] @ betas
    joints = arrays["J_regressor"] @ shaped
    local = Rotation.from_rotvec(pose.reshape(16, 3)).as_matrix()
    posed = shaped + arrays["posedirs"] @ (local[1:] - np.eye(3)).ravel()
    world: list[Array] = []
    for joint, parent in enumerate(JOINT_PARENTS):
        here = np.eye(4)
        here[:3, :3] = local[joint]
        here[:3, 3] = joints[joint] - (joints[parent] if parent >= 0 else 0)
        world.append(world[parent] @ here if parent >= 0 else here)
    skinned = np.zeros_like(posed)
    for joint in range(16):
        moved = (posed - joints[joint]) @ world[joint][:3, :3].T + world[joint][:3, 3]
        skinned += arrays["weights"][:, [joint]] * moved
    return skinned + transl, np.array([matrix[:3, 3] for matrix in world]) + transl


def random_pose(seed: int) -> tuple[Array, Array, Array]:
    random = np.random.default_rng(seed)
    return random.normal(0, 1, 10), random.normal(0, 0.5, 48), random.normal(0, 0.3, 3)


def as_pose(betas: Array, pose: Array, transl: Array, side: Any = "right") -> HandPose:
    shape, orient, fingers, place = (torch.from_numpy(x) for x in (betas, pose[:3], pose[3:], transl))
    return HandPose(shape, orient, fingers, place, side)


@pytest.mark.parametrize("shape", ["builtin", "random"])
def test_vertices_and_joints_follow_the_formulas(tmp_path: Path, shape: str) -> None:
    arrays = mano_arrays(1, shape=shape)
    model = read_mano(write_mano(tmp_path / "MANO_RIGHT.pkl", arrays)).model(dtype=torch.float64)
    for seed in range(3):
        betas, pose, transl = random_pose(seed)
        vertices, joints = model(as_pose(betas, pose, transl))
        expected, places = formulas(arrays, betas, pose, transl)
        np.testing.assert_allclose(vertices.numpy(), expected, atol=1e-12)
        np.testing.assert_allclose(joints[:16].numpy(), places, atol=1e-12)


def test_the_working_precision_stays_close_to_the_formulas(tmp_path: Path) -> None:
    arrays = mano_arrays(2)
    model = read_mano(write_mano(tmp_path / "m.pkl", arrays)).model()
    assert model.template.dtype == torch.float32
    betas, pose, transl = random_pose(5)
    parts = [torch.tensor(x, dtype=torch.float32) for x in (betas, pose[:3], pose[3:], transl)]
    vertices, _ = model(HandPose(parts[0], parts[1], parts[2], parts[3]))
    np.testing.assert_allclose(vertices.numpy(), formulas(arrays, betas, pose, transl)[0], atol=1e-6)


@pytest.mark.parametrize("convention", ["smplx", "manopth"])
def test_fingertips_are_the_vertices_of_the_convention(tmp_path: Path, convention: str) -> None:
    arrays = mano_arrays(3)
    file = read_mano(write_mano(tmp_path / "m.pkl", arrays))
    model = file.model(convention, torch.float64)
    betas, pose, transl = random_pose(1)
    shaped = arrays["v_template"] + arrays["shapedirs"] @ betas
    _, joints = model(as_pose(betas, 0 * pose, transl))
    rows = list(TIP_VERTICES[convention])
    np.testing.assert_allclose(joints[16:].numpy(), shaped[rows] + transl, atol=1e-12)
    vertices, _ = model(as_pose(betas, pose, transl))
    expected, _ = formulas(arrays, betas, pose, transl)
    np.testing.assert_allclose(file.tips(vertices, convention).numpy(), expected[rows], atol=1e-12)
    assert TIP_VERTICES["smplx"] != TIP_VERTICES["manopth"]


def test_other_mesh_sizes_get_tips_from_their_form(tmp_path: Path) -> None:
    arrays = mano_arrays(3, vertices=None)
    tips = read_mano(write_mano(tmp_path / "m.pkl", arrays)).model().joint_template[16:].numpy()
    from mass_engine.hand.builtin import load_builtin

    expected = load_builtin("right").joint_template[16:].numpy()
    assert np.linalg.norm(tips - expected, axis=1).max() < 0.004


def test_the_mean_pose_is_added_only_where_parameters_need_it(tmp_path: Path) -> None:
    arrays = mano_arrays(4)
    file = read_mano(write_mano(tmp_path / "m.pkl", arrays))
    coefficients = torch.from_numpy(np.random.default_rng(0).normal(size=(2, 6)))
    expected = coefficients.numpy() @ arrays["hands_components"][:6]
    np.testing.assert_allclose(file.hand_pose(coefficients, pca=True, flat_hand_mean=True), expected)
    np.testing.assert_allclose(file.hand_pose(coefficients, pca=True), expected + arrays["hands_mean"])
    full = torch.zeros(45, dtype=torch.float64)
    np.testing.assert_allclose(file.hand_pose(full), arrays["hands_mean"])
    assert torch.equal(file.hand_pose(full, flat_hand_mean=True), full)
    # Zero of the engine is the flat hand, whatever the mean.
    vertices, _ = file.model(dtype=torch.float64)(as_pose(np.zeros(10), np.zeros(48), np.zeros(3)))
    np.testing.assert_allclose(vertices.numpy(), arrays["v_template"], atol=1e-12)
    for size, pca in ((46, True), (44, False), (0, True)):
        with pytest.raises(EngineError, match="finger parameters"):
            file.hand_pose(torch.zeros(size), pca=pca)


@pytest.mark.parametrize("fault", [True, False])
def test_the_left_hand_is_the_mirrored_right_one_with_its_sign_fault_or_without(
    tmp_path: Path, fault: bool
) -> None:
    arrays = mano_arrays(5)
    right = read_mano(write_mano(tmp_path / "MANO_RIGHT.pkl", arrays))
    left = read_mano(write_mano(tmp_path / "MANO_LEFT.pkl", left_arrays(arrays, fault)))
    assert (right.side, left.side) == ("right", "left")
    assert left.sign_fault == fault
    assert not right.sign_fault
    betas, pose, transl = random_pose(2)
    turned = mirror_pose(torch.from_numpy(pose)).numpy()
    flip = np.array([-1.0, 1.0, 1.0])
    one, joints = right.model(dtype=torch.float64)(as_pose(betas, pose, transl))
    two, others = left.model(dtype=torch.float64)(as_pose(betas, turned, transl * flip, "left"))
    np.testing.assert_allclose(two.numpy(), one.numpy() * flip, atol=1e-12)
    np.testing.assert_allclose(others.numpy(), joints.numpy() * flip, atol=1e-12)


@pytest.mark.parametrize("suffix", [".npz", ".safetensors"])
@pytest.mark.parametrize("side", ["right", "left"])
def test_converted_forms_hold_the_same(tmp_path: Path, suffix: str, side: str) -> None:
    arrays = mano_arrays(6)
    source = write_mano(tmp_path / "m.pkl", arrays if side == "right" else left_arrays(arrays, True))
    assert main([str(source), str(tmp_path / f"m{suffix}")]) == 0
    first, again = read_mano(source), read_mano(tmp_path / f"m{suffix}")
    assert again.side == side
    assert not again.sign_fault  # it was put right before
    for name in ("v_template", "f", "shapedirs", "posedirs", "J_regressor", "weights", "hands_mean"):
        np.testing.assert_array_equal(getattr(again, name), getattr(first, name))


@pytest.mark.parametrize("protocol", [0, 1, 2, 3, 4, 5])
def test_pickles_of_plain_arrays_by_today_s_python(tmp_path: Path, protocol: int) -> None:
    arrays = mano_arrays(7)
    import scipy.sparse as sp

    for layout in ("csc", "csr", "coo"):
        content = {**arrays, "J_regressor": sp.coo_matrix(arrays["J_regressor"]).asformat(layout)}
        content["weights"] = np.asfortranarray(arrays["weights"])
        (tmp_path / "m.pkl").write_bytes(pickle.dumps(content, protocol))
        file = read_mano(tmp_path / "m.pkl")
        np.testing.assert_array_equal(file.weights, arrays["weights"])
        np.testing.assert_array_equal(file.J_regressor, arrays["J_regressor"])


def change(arrays: dict[str, Any], name: str) -> None:
    if name == "lacks":
        del arrays["posedirs"]
    elif name == "posedirs":
        arrays["posedirs"] = arrays["posedirs"][..., :134]
    elif name == "not finite":
        arrays["v_template"][3, 1] = np.nan
    elif name == "order":
        arrays["kintree_table"] = arrays["kintree_table"].copy()
        arrays["kintree_table"][0, 4] = 3
    elif name == "face":
        arrays["f"][5, 1] = 778
    elif name == "weights":
        arrays["weights"] = arrays["weights"] * 1.01
    elif name == "metres":
        arrays["v_template"] *= 1000
    else:
        arrays["v_template"] = arrays["v_template"][:, [2, 1, 0]]


@pytest.mark.parametrize(
    "problem", ["lacks", "posedirs", "not finite", "order", "face", "weights", "metres", "does not lie as"]
)
def test_a_file_that_is_no_whole_hand_is_refused_by_name(tmp_path: Path, problem: str) -> None:
    arrays = mano_arrays(8)
    change(arrays, problem)
    np.savez(tmp_path / "m.npz", **arrays)
    with pytest.raises(EngineError, match=problem) as caught:
        read_mano(tmp_path / "m.npz")
    assert caught.value.code == "template.incomplete"


@pytest.mark.parametrize("data", [b"", b"text", b"PK\x03\x04 no zip", b"\x80\x02}.", b"\x80\x02]."])
def test_other_files_are_refused(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "m.pkl").write_bytes(data)
    with pytest.raises(EngineError) as caught:
        read_mano(tmp_path / "m.pkl")
    assert caught.value.code in ("template.unreadable", "template.incomplete")


def test_an_npz_that_unpacks_to_gigabytes_is_refused_unread(tmp_path: Path) -> None:
    import zipfile

    with zipfile.ZipFile(tmp_path / "m.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("v_template.npy", bytes(300 << 20))
    with pytest.raises(EngineError, match="unpacks to 300 MiB"):
        read_mano(tmp_path / "m.npz")


def test_an_npz_of_objects_is_refused(tmp_path: Path) -> None:
    file = io.BytesIO()
    np.savez(file, v_template=np.array([{}], object))
    (tmp_path / "m.npz").write_bytes(file.getvalue())
    with pytest.raises(EngineError) as caught:
        read_mano(tmp_path / "m.npz")
    assert caught.value.code == "template.unreadable"
