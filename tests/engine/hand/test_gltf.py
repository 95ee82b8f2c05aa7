"""Rigged hands out of glTF files, against the built-in hand they were made of."""

from __future__ import annotations

import base64
import contextlib
import json
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mass_engine.errors import EngineError
from mass_engine.hand import gltf, gltf_file
from mass_engine.hand.builtin import joint_frames, load_builtin
from mass_engine.hand.gltf import read_rigged_hand
from mass_engine.hand.model import HandModel
from mass_engine.hand.pose import JOINT_NAMES, HandPose, Side
from tests.engine.hand.files import Rig, builtin_rig, glb, split_seams, with_joints, write_glb
from tests.engine.hand.rigs import STYLES, rig_name


def vertex_distance(a: HandModel, b: HandModel) -> float:
    """Greatest distance of a vertex of ``a`` to the nearest of ``b`` (order does not matter), metres."""
    return float(torch.cdist(a.template.double(), b.template.double()).amin(1).max())


def turned(rig: Rig, scale: float, turn: Rotation, shift: Any = (0.3, 1.2, -0.4)) -> Rig:
    def move(points: Any) -> Any:
        return turn.apply(points) * scale + np.array(shift) * scale

    joints = [(name, parent, move(place)) for name, parent, place in rig.joints]
    return Rig(move(rig.vertices), rig.faces, joints, rig.weights, rig.extra)


@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("style", STYLES)
def test_the_built_in_hand_comes_back_under_any_names(tmp_path: Path, style: str, side: Side) -> None:
    rig = builtin_rig(side).renamed(lambda name: rig_name(style, name, side))
    model, notes = read_rigged_hand(write_glb(tmp_path / "hand.glb", rig))
    own = load_builtin(side)
    assert model.side == side
    assert notes == []
    assert vertex_distance(model, own) < 1e-6
    torch.testing.assert_close(model.joint_template, own.joint_template, atol=1e-6, rtol=0)
    assert len(model.template) == len(own.template)
    assert len(model.faces) == len(own.faces)
    order = torch.cdist(own.template, model.template).argmin(1)
    torch.testing.assert_close(model.weights[order], own.weights, atol=1e-4, rtol=0)
    # Faces look outward.
    corners = model.template[model.faces].double()
    assert torch.linalg.det(corners).sum() > 0


@pytest.mark.parametrize(
    ("scale", "unit"),
    [(1.0, None), (100.0, "centimetres"), (1000.0, "millimetres"), (5.0, "an unknown unit")],
)
def test_units_and_axes_are_found_from_the_hand_itself(
    tmp_path: Path, scale: float, unit: str | None
) -> None:
    rig = turned(builtin_rig("left"), scale, Rotation.from_rotvec([0.4, 2.0, -1.1]))
    model, notes = read_rigged_hand(write_glb(tmp_path / "hand.glb", rig))
    assert model.side == "left"
    assert vertex_distance(model, load_builtin("left")) < 2e-6
    assert [code for code, _ in notes] == ([] if unit is None else ["template.units"])
    assert unit is None or unit in notes[0][1]


def test_a_pose_does_to_a_rig_what_it_does_to_the_built_in_hand(tmp_path: Path) -> None:
    rig = turned(builtin_rig(), 100, Rotation.from_rotvec([1, 0, 0]))
    model, _ = read_rigged_hand(write_glb(tmp_path / "hand.glb", rig))
    pose = replace(
        HandPose.rest(), hand_pose=torch.randn(45, generator=torch.Generator().manual_seed(1)) * 0.4
    )
    own = replace(load_builtin("right"), pose_basis=None)
    torch.testing.assert_close(model.joints(pose), own.joints(pose), atol=2e-6, rtol=0)
    moved = replace(own, template=own(pose)[0])
    assert vertex_distance(replace(model, template=model(pose)[0]), moved) < 2e-4  # eight weights a vertex


def test_a_bent_bind_pose_is_laid_flat(tmp_path: Path) -> None:
    own = replace(load_builtin("right"), pose_basis=None)
    degrees = torch.tensor([25.0, 20.0, 15.0]).repeat(5)
    fingers = (torch.deg2rad(degrees)[:, None] * joint_frames(own)[:, 0]).flatten()
    posed = own.posed(replace(HandPose.rest(), hand_pose=fingers))
    plain = builtin_rig()
    joints = [
        (name, parent, posed.joints[row].double().numpy())
        for row, (name, parent, _) in enumerate(plain.joints)
    ]
    rig = Rig(posed.vertices.double().numpy(), plain.faces, joints, plain.weights)
    model, notes = read_rigged_hand(write_glb(tmp_path / "hand.glb", rig))
    torch.testing.assert_close(model.joint_template, own.joint_template, atol=1e-6, rtol=0)
    # Skinning there and back loses a little where it blends; nothing of the fingers' length.
    assert vertex_distance(model, own) < 0.004
    assert [code for code, _ in notes] == ["template.rest_pose"]
    assert "60 degrees" in notes[0][1]


def test_missing_tips_are_found_and_bones_of_the_palm_go_with_the_wrist(tmp_path: Path) -> None:
    rig = builtin_rig(tips=False)
    own = load_builtin("right")
    palm = [(f"{digit}_metacarpal", 0, np.array([-0.03, 0.0, 0.0])) for digit in ("index", "ring")]
    rig = with_joints(rig, palm)
    rig.weights[:, 16] = rig.weights[:, 0] * 0.6  # the palm is moved by a metacarpal for the most part
    rig.weights[:, 0] *= 0.4
    model, notes = read_rigged_hand(write_glb(tmp_path / "hand.glb", rig))
    order = torch.cdist(own.template, model.template).argmin(1)
    torch.testing.assert_close(model.weights[order], own.weights, atol=1e-4, rtol=0)
    assert (model.joint_template[16:] - own.joint_template[16:]).norm(dim=1).max() < 0.004
    assert notes[0][0] == "template.tips"


def test_twist_bones_go_with_their_parents_and_the_forearm_is_cut_off(tmp_path: Path) -> None:
    rig = builtin_rig(tips=False)
    arm = np.array([0.2, 0.0, 0.0])
    rig = with_joints(rig, [("ik helper", 1, arm), ("forearm", -1, arm)])
    rig.joints[0] = ("wrist", 17, rig.joints[0][2])
    rig.weights[:, 16] = rig.weights[:, 1] * 0.5
    rig.weights[:, 1] *= 0.5
    beyond = rig.vertices[:, 0] > 0.015
    rig.weights[beyond] = 0
    rig.weights[beyond, 17] = 1
    model, _ = read_rigged_hand(write_glb(tmp_path / "hand.glb", rig))
    own = load_builtin("right")
    assert float(model.template[:, 0].max()) < 0.02
    assert len(model.template) == int((~beyond).sum())
    order = torch.cdist(model.template, own.template).argmin(1)
    torch.testing.assert_close(model.weights, own.weights[order], atol=1e-4, rtol=0)


def test_seams_are_welded_and_doubled_faces_dropped(tmp_path: Path) -> None:
    rig = split_seams(builtin_rig())
    rig = replace(rig, faces=np.concatenate([rig.faces, rig.faces[:500, ::-1]]))
    model, _ = read_rigged_hand(write_glb(tmp_path / "hand.glb", rig))
    own = load_builtin("right")
    assert model.template.shape == own.template.shape
    assert model.faces.shape == own.faces.shape


@pytest.mark.parametrize("small", [True, False])
@pytest.mark.parametrize("embed", [True, False])
def test_forms_of_the_same_file(tmp_path: Path, small: bool, embed: bool) -> None:
    path = tmp_path / ("hand.glb" if embed else "hand.gltf")
    model, _ = read_rigged_hand(write_glb(path, builtin_rig(), small=small, embed=embed))
    assert vertex_distance(model, load_builtin("right")) < 1e-6
    if not embed:
        content = json.loads(path.read_text())
        data = base64.b64encode(path.with_suffix(".bin").read_bytes()).decode()
        content["buffers"][0]["uri"] = "data:application/octet-stream;base64," + data
        (tmp_path / "inline.gltf").write_text(json.dumps(content))
        again, _ = read_rigged_hand(tmp_path / "inline.gltf")
        assert torch.equal(again.template, model.template)


def test_inward_faces_are_turned(tmp_path: Path) -> None:
    rig = builtin_rig()
    model, _ = read_rigged_hand(write_glb(tmp_path / "a.glb", replace(rig, faces=rig.faces[:, ::-1])))
    assert torch.linalg.det(model.template[model.faces].double()).sum() > 0


def test_shape_parameters_scale_the_hand_and_move_its_bones(tmp_path: Path) -> None:
    model, _ = read_rigged_hand(write_glb(tmp_path / "hand.glb", builtin_rig()))
    own = load_builtin("right")
    torch.testing.assert_close(model.joint_shape_basis, own.joint_shape_basis, atol=1e-5, rtol=0)
    torch.testing.assert_close(model.shape_basis[..., 0], 0.06 * model.template)
    order = torch.cdist(own.template, model.template).argmin(1)
    for parameter in (1, 2, 3, 4, 8, 9):  # those that move joints
        close = (model.shape_basis[order, :, parameter] - own.shape_basis[..., parameter]).norm(dim=-1)
        size = own.shape_basis[..., parameter].norm(dim=-1)
        assert close.mean() < 0.25 * size[size > 2e-4].mean(), parameter
    assert model.shape_basis[..., 5:8].abs().max() == 0


def test_a_flat_mitten_needs_to_be_told_its_side(tmp_path: Path) -> None:
    rig = builtin_rig()
    flat = np.array([1.0, 0.0, 1.0])
    joints = [(name, parent, place * flat) for name, parent, place in rig.joints]
    rig = Rig(rig.vertices * flat, rig.faces, joints, rig.weights)
    path = write_glb(tmp_path / "hand.glb", rig)
    with pytest.raises(EngineError) as caught:
        read_rigged_hand(path)
    assert caught.value.code == "template.side_unknown"
    assert read_rigged_hand(path, side="right")[0].side == "right"
    path.rename(tmp_path / "left.glb")
    assert read_rigged_hand(tmp_path / "left.glb")[0].side == "left"


def test_names_that_say_nothing_need_a_mapping(tmp_path: Path) -> None:
    rig = builtin_rig(tips=False)
    names = {name: f"Bone.{row:03}" for row, (name, _, _) in enumerate(rig.joints)}
    path = write_glb(tmp_path / "hand.glb", rig.renamed(names.__getitem__))
    with pytest.raises(EngineError, match=r"wrist, index1.*Bone\.000") as caught:
        read_rigged_hand(path)
    assert caught.value.code == "template.joints_missing"
    assert "joints=MAP.json" in caught.value.advice
    (tmp_path / "map.json").write_text(json.dumps({**names, "side": "right"}))
    model, _ = read_rigged_hand(path, tmp_path / "map.json")
    assert vertex_distance(model, load_builtin("right")) < 1e-6
    del names["ring2"]
    (tmp_path / "map.json").write_text(json.dumps(names))
    with pytest.raises(EngineError, match=r"No joint was found for ring2\. Not understood: Bone\.011"):
        read_rigged_hand(path, tmp_path / "map.json")
    for bad in ("[]", "{", '{"wrist": "Bon"}', "\x80"):
        (tmp_path / "map.json").write_text(bad, encoding="latin1")
        with pytest.raises(EngineError) as caught:
            read_rigged_hand(path, tmp_path / "map.json")
        assert caught.value.code == "template.joint_map"


def test_knuckles_named_as_metacarpals_are_noticed(tmp_path: Path) -> None:
    rig = builtin_rig(tips=False)
    # Four bones a finger, numbered from the palm: what is called 1 is no knuckle.
    rig.joints[1] = ("index1", 0, np.array([-0.025, 0.0, 0.012]))
    with pytest.raises(EngineError, match="wrist to index1") as caught:
        read_rigged_hand(write_glb(tmp_path / "hand.glb", rig))
    assert caught.value.code == "template.proportions"


def test_too_many_triangles_are_refused_with_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_glb(tmp_path / "hand.glb", builtin_rig())
    monkeypatch.setattr(gltf, "MOST_FACES", 2000)
    with pytest.raises(EngineError, match=f"{len(builtin_rig().faces)} triangles") as caught:
        read_rigged_hand(path)
    assert caught.value.code == "template.too_large"
    monkeypatch.setattr(gltf, "MOST_VERTICES", 1000)
    with pytest.raises(EngineError, match="more than 1000 vertices"):
        read_rigged_hand(path)


Change = Callable[[dict[str, Any]], object]
PROBLEMS: dict[str, tuple[str, Change]] = {
    "draco": ("compressed", lambda c: c["meshes"][0]["primitives"][0].update(
        extensions={"KHR_draco_mesh_compression": {}})),
    "draco required": ("compressed", lambda c: c.update(extensionsRequired=["KHR_draco_mesh_compression"])),
    "meshopt": ("compressed", lambda c: c["bufferViews"][0].update(
        extensions={"EXT_meshopt_compression": {}})),
    "sparse": ("sparse", lambda c: c["accessors"][0].update(sparse={"count": 1})),
    "version": ("version 1.0", lambda c: c["asset"].update(version="1.0")),
    "strip": ("triangles", lambda c: c["meshes"][0]["primitives"][0].update(mode=5)),
    "no matrices": ("inverse bind", lambda c: c["skins"][0].pop("inverseBindMatrices")),
    "no skin": ("no skinned mesh", lambda c: c.pop("skins")),
    "no mesh": ("No mesh", lambda c: c["nodes"][-1].pop("mesh")),
    "huge count": ("beyond its data", lambda c: c["accessors"][0].update(count=1 << 39)),
    "count zero": ("beyond its data", lambda c: c["accessors"][0].update(count=0)),
    "negative count": ("count is -5", lambda c: c["accessors"][0].update(count=-5)),
    "count text": ("count is", lambda c: c["accessors"][0].update(count="9")),
    "count true": ("count is True", lambda c: c["accessors"][0].update(count=True)),
    "no data": ("has no data", lambda c: c["accessors"][0].pop("bufferView")),
    "stride": ("beyond its data", lambda c: c["bufferViews"][0].update(byteStride=4)),
    "view offset": ("beyond its data", lambda c: c["bufferViews"][0].update(byteOffset=1 << 30)),
    "buffer": ("buffer is not there", lambda c: c["bufferViews"][0].update(buffer=3)),
    "buffer length": ("shorter", lambda c: c["buffers"][0].update(byteLength=1 << 33)),
    "accessor": ("no accessors", lambda c: c["meshes"][0]["primitives"][0]["attributes"].update(POSITION=99)),
    "kind": ("is VEC2", lambda c: c["accessors"][0].update(type="VEC2")),
    "joint node": ("no nodes", lambda c: c["skins"][0]["joints"].append(4000)),
    "many joints": ("list of joints", lambda c: c["skins"][0].update(joints=[0] * 5000)),
    "nodes": ("no list", lambda c: c.update(nodes={"a": 1})),
    "circle": ("No joint|no part|No mesh|", lambda c: c["nodes"][3].update(children=[0])),
    "indices": ("no whole|is SCALAR", lambda c: c["accessors"][5].update(componentType=5126)),
    "attributes": ("no positions", lambda c: c["meshes"][0]["primitives"][0].update(attributes=[])),
    "uri": ("outside its own folder", lambda c: c["buffers"][0].update(uri="../hand.bin")),
    "uri absolute": ("outside its own folder", lambda c: c["buffers"][0].update(uri="/etc/passwd")),
    "uri coded": ("outside its own folder", lambda c: c["buffers"][0].update(uri="%2e%2e%2fhand.bin")),
    "uri web": ("outside its own folder", lambda c: c["buffers"][0].update(uri="http://localhost/a.bin")),
    "uri nul": ("outside its own folder", lambda c: c["buffers"][0].update(uri="a\x00b")),
    "uri missing": ("cannot be read", lambda c: c["buffers"][0].update(uri="other.bin")),
    "uri data": ("not base64", lambda c: c["buffers"][0].update(uri="data:;base64,!!!")),
    "uri plain": ("not base64", lambda c: c["buffers"][0].update(uri="data:text/plain,hello")),
    "uri number": ("no text", lambda c: c["buffers"][0].update(uri=3)),
}  # fmt: skip


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, bytes]:
    """The JSON and the bytes of a good file."""
    data = write_glb(tmp_path_factory.mktemp("glb") / "hand.glb", builtin_rig()).read_bytes()
    (size,) = struct.unpack_from("<I", data, 12)
    return data[20 : 20 + size], data[28 + size :]


@pytest.mark.parametrize("name", [name for name in PROBLEMS if name != "circle"])
def test_what_cannot_be_read_says_why(tmp_path: Path, parts: tuple[bytes, bytes], name: str) -> None:
    problem, spoil = PROBLEMS[name]
    content = json.loads(parts[0])
    spoil(content)
    (tmp_path / "hand.glb").write_bytes(glb(content, parts[1]))
    with pytest.raises(EngineError, match=problem) as caught:
        read_rigged_hand(tmp_path / "hand.glb")
    assert caught.value.code.startswith("template.")


def test_a_circle_of_nodes_ends(tmp_path: Path, parts: tuple[bytes, bytes]) -> None:
    content = json.loads(parts[0])
    content["nodes"] += [{"name": "a", "children": [len(content["nodes"]) + 1]}]
    content["nodes"] += [{"name": "b", "children": [len(content["nodes"]) - 1]}]
    content["skins"][0]["joints"].append(len(content["nodes"]) - 1)
    matrices = content["accessors"][content["skins"][0]["inverseBindMatrices"]]
    matrices["count"] += 1
    content["bufferViews"][matrices["bufferView"]]["byteLength"] += 64
    content["buffers"][0]["byteLength"] += 64
    blob = parts[1] + np.eye(4, dtype="<f4").tobytes()
    (tmp_path / "hand.glb").write_bytes(glb(content, blob))
    assert read_rigged_hand(tmp_path / "hand.glb")[0].side == "right"


def test_a_link_out_of_the_folder_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "inner").mkdir()
    path = write_glb(tmp_path / "inner" / "hand.gltf", builtin_rig(), embed=False)
    (tmp_path / "inner" / "hand.bin").rename(tmp_path / "hand.bin")
    (tmp_path / "inner" / "hand.bin").symlink_to(tmp_path / "hand.bin")
    with pytest.raises(EngineError, match="outside its own folder"):
        read_rigged_hand(path)


@pytest.mark.parametrize(
    "data",
    [b"", b"glTF", b"glTF\x02\x00\x00\x00\xff\xff\xff\xff", b"{}", b"[]", b"\xff", b"[" * 200_000, b"nan"],
)
def test_other_files_are_refused(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "hand.glb").write_bytes(data)
    with pytest.raises(EngineError) as caught:
        read_rigged_hand(tmp_path / "hand.glb")
    assert caught.value.code == "template.gltf_invalid"


def test_a_file_too_large_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_glb(tmp_path / "hand.glb", builtin_rig())
    monkeypatch.setattr(gltf_file, "MOST_JSON", 100)
    with pytest.raises(EngineError, match="JSON"):
        read_rigged_hand(path)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    cut=st.integers(0, 60_000),
    flips=st.lists(st.tuples(st.integers(0, 9000), st.integers(0, 255)), min_size=1, max_size=4),
)
def test_damaged_files_end_in_an_error_or_are_read(
    parts: tuple[bytes, bytes],
    cut: int,
    flips: list[tuple[int, int]],
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    head = bytearray(parts[0])
    for place, value in flips:
        head[place % len(head)] = value
    blob = parts[1][: max(0, len(parts[1]) - max(0, cut - 30_000))]
    chunks = (
        struct.pack("<I4s", len(head), b"JSON") + head + struct.pack("<I4s", len(blob), b"BIN\x00") + blob
    )
    path = tmp_path_factory.mktemp("damaged") / "hand.glb"
    path.write_bytes(b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks)
    # Anything but an EngineError, a crash or a hang fails the test.
    with contextlib.suppress(EngineError):
        read_rigged_hand(path)


def test_joint_rows_are_complete() -> None:
    assert [name for name, _, _ in builtin_rig().joints] == list(JOINT_NAMES)
