"""Other programs' poses: what goes in comes out, for both hands, on the user's MANO and on other hands."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mass_engine.camera import Camera
from mass_engine.errors import EngineError
from mass_engine.hand.pose import Side
from mass_engine.hand.template import Template, load_template
from mass_engine.template_spec import parse_template
from mass_engine.tracking.imports.load import LoadedTracks, load_tracks
from mass_engine.tracking.imports.placing import project, solve_translation
from mass_engine.tracking.tracks import write_tracks
from mass_engine.tracks_spec import parse_tracks
from mass_engine.video.reader import VideoInfo
from tests.engine.hand.files import left_arrays, mano_arrays, write_mano
from tests.engine.tracking.import_files import (
    MIRROR,
    SIZE,
    Array,
    Clip,
    bent,
    flat,
    make_clip,
    network_output,
    rows,
    wilor_mini,
    write_arctic,
    write_harp,
)
from tests.engine.tracking.test_tracks import tracks as own_tracks

BUILTIN = Template("builtin", load_template(parse_template("builtin")).hand)


def right_arrays() -> dict[str, Any]:
    """With the origin where MANO's is: away from the wrist."""
    arrays = mano_arrays(3)
    return {**arrays, "v_template": arrays["v_template"] + [0.0957, 0.0064, 0.0062]}


def arrays_of(side: Side) -> dict[str, Any]:
    right = right_arrays()
    return right if side == "right" else left_arrays(right, fault=False)


@pytest.fixture(scope="module")
def mano(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_mano(tmp_path_factory.mktemp("mano") / "MANO_RIGHT.pkl", right_arrays())


@pytest.fixture(scope="module")
def template(mano: Path) -> Template:
    return load_template(parse_template(f"mano:{mano}"))


def load(
    text: str | Path,
    template: Template = BUILTIN,
    side: str = "auto",
    *,
    size: tuple[int, int] = SIZE,
    frames: int | None = None,
    focal: float | None = None,
) -> LoadedTracks:
    """``focal`` in pixels: what the user says; None: 60 degrees are assumed."""
    info = VideoInfo(*size, frames, 30.0, None, "h264", 0)
    camera = Camera.from_fov(*size, 60.0)
    if focal is not None:
        K = camera.K.double().clone()
        K[0, 0] = K[1, 1] = focal
        camera = replace(camera, K=K)
    return load_tracks(
        parse_tracks(str(text)), template, info, side, camera, focal is not None, lambda _: False
    )


def codes(loaded: LoadedTracks) -> set[str]:
    return {code for code, _, _ in loaded.notes}


def check(loaded: LoadedTracks, template: Template, pose: Array, pixels: Array) -> None:
    """The same rotations, and the template posed by them lies on the same pixels."""
    tracks = loaded.tracks
    assert tracks.template == template.name
    np.testing.assert_allclose(tracks.landmarks2d, pixels, atol=0.01)
    vectors = torch.cat([tracks.pose.global_orient, tracks.pose.hand_pose], -1).double().numpy()
    turned = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()
    np.testing.assert_allclose(turned, Rotation.from_rotvec(pose.reshape(-1, 3)).as_matrix(), atol=1e-5)
    model = template.model(tracks.pose.side).to("cpu", torch.float64)
    parts = [
        getattr(tracks.pose, name).double() for name in ("betas", "global_orient", "hand_pose", "transl")
    ]
    joints = model.joints(
        replace(
            tracks.pose, **dict(zip(("betas", "global_orient", "hand_pose", "transl"), parts, strict=True))
        )
    ).numpy()
    np.testing.assert_allclose(project(joints, tracks.K.double().numpy()), pixels, atol=0.01)


def save(path: Path, form: str, clip: Clip) -> Path:
    output = network_output(clip)
    if form == "npz":
        np.savez(path / "clip.npz", **flat(output))
        return path / "clip.npz"
    if form == "pkl":
        (path / "clip.pkl").write_bytes(pickle.dumps(output))
        return path / "clip.pkl"
    if form == "npy":
        np.save(path / "clip.npy", np.array(output, dtype=object), allow_pickle=True)
        return path / "clip.npy"
    if form == "names":
        named = {f"/x/clip2/{row:06d}.jpg": {"out": rows(output, row)} for row in range(len(clip.pose))}
        (path / "named.pkl").write_bytes(pickle.dumps(named))
        return path / "named.pkl"
    if form == "mini":
        (path / "mini.pkl").write_bytes(pickle.dumps(wilor_mini(clip)))
        return path / "mini.pkl"
    folder = path / "folder"
    folder.mkdir()
    for row in range(len(clip.pose)):
        np.savez(folder / f"clip2_{row:06d}_0.npz", **flat(rows(output, row)))
    return folder


@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("form", ["npz", "pkl", "npy", "names", "mini", "folder"])
def test_wilor_and_hamer_come_back(tmp_path: Path, template: Template, form: str, side: Side) -> None:
    clip = make_clip(arrays_of(side), side)
    path = save(tmp_path, form, clip)
    loaded = load(path, template, focal=clip.focal)
    assert loaded.tracks.pose.side == side
    assert loaded.tracks.indices == list(range(5))
    assert not codes(loaded)
    check(loaded, template, clip.pose, clip.pixels())
    np.testing.assert_allclose(loaded.tracks.pose.betas[0], clip.betas, atol=1e-5)
    np.testing.assert_allclose(loaded.tracks.pose.transl, clip.transl, atol=1e-4)
    assert load(f"hamer:{path}", template, focal=clip.focal).tracks.indices == loaded.tracks.indices


@pytest.mark.parametrize("joints", [True, False])
@pytest.mark.parametrize("flipped", [True, False])
def test_a_left_hand_s_camera_is_understood_however_it_was_left(
    tmp_path: Path, template: Template, flipped: bool, joints: bool
) -> None:
    clip = make_clip(arrays_of("left"), "left")
    np.savez(tmp_path / "a.npz", **flat(network_output(clip, flipped_tx=flipped, joints=joints)))
    check(load(tmp_path / "a.npz", template, focal=clip.focal), template, clip.pose, clip.pixels())


def test_the_real_camera_gets_its_own_translation(tmp_path: Path, template: Template) -> None:
    clip = make_clip(arrays_of("right"))
    np.savez(tmp_path / "a.npz", **flat(network_output(clip)))
    loaded = load(tmp_path / "a.npz", template)
    assert not loaded.camera_known
    pose, K = loaded.tracks.pose, loaded.tracks.K.double().numpy()
    np.testing.assert_allclose(K[0, 0], 320 / np.tan(np.radians(30)), rtol=1e-6)
    np.testing.assert_allclose(pose.hand_pose, clip.pose[:, 3:], atol=1e-5)
    assert (pose.transl[:, 2] < 0.06 * torch.tensor(clip.transl[:, 2])).all()  # f is 22 times shorter
    # No other place is nearer to the pixels.
    placed = clip.local + pose.transl.double().numpy()[:, None]

    def error(points: Array) -> Array:
        return np.asarray(((project(points, K) - clip.pixels()) ** 2).sum((1, 2)))

    for axis in range(3):
        for step in (-0.0003, 0.0003):
            shift = np.zeros(3)
            shift[axis] = step
            assert (error(placed + shift) > error(placed)).all()


def test_the_translation_is_exact_where_the_points_are() -> None:
    random = np.random.default_rng(1)
    points, shift = (
        random.normal(0, 0.05, (7, 21, 3)),
        random.uniform((-0.1, -0.1, 0.3), (0.1, 0.1, 2), (7, 3)),
    )
    K = np.array([[700.0, 3, 300], [0, 650, 260], [0, 0, 1]])
    pixels = project(points + shift[:, None], K)
    np.testing.assert_allclose(solve_translation(points, pixels, K), shift, atol=1e-9)


def test_two_hands_in_one_file(tmp_path: Path, template: Template) -> None:
    right, left = make_clip(arrays_of("right"), "right", 6), make_clip(arrays_of("left"), "left", 6, seed=4)
    frames = [
        a + (b if row % 2 else [])
        for row, (a, b) in enumerate(zip(wilor_mini(right), wilor_mini(left), strict=True))
    ]
    frames[2] = []
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(frames))
    most = load(tmp_path / "a.pkl", template, focal=right.focal)
    assert (most.tracks.pose.side, most.tracks.indices) == ("right", [0, 1, 3, 4, 5])
    other = load(tmp_path / "a.pkl", template, "left", focal=left.focal)
    assert (other.tracks.pose.side, other.tracks.indices) == ("left", [1, 3, 5])
    check(other, template, left.pose[1::2], left.pixels()[1::2])


def test_the_more_certain_of_two_is_taken_and_missing_frames_stay_missing(
    tmp_path: Path, template: Template
) -> None:
    clip = make_clip(arrays_of("right"))
    output = flat(network_output(clip))
    doubled: dict[str, Any] = {name: np.concatenate([value, value[::-1]]) for name, value in output.items()}
    # The second five are a worse reading, of the frames in another order.
    doubled["frame_ids"] = np.array([0, 1, 2, 3, 4, 0, 3, 2, 1, 4])
    doubled["score"] = np.array([1.0] * 5 + [0.3] * 5)
    doubled["hand_pose"][[3, 6]] = np.nan  # both of frame 3
    np.savez(tmp_path / "a.npz", **doubled)
    loaded = load(tmp_path / "a.npz", template, focal=clip.focal)
    assert loaded.tracks.indices == [0, 1, 2, 4]
    assert codes(loaded) == {"tracks.frames_dropped"}
    check(loaded, template, clip.pose[[0, 1, 2, 4]], clip.pixels()[[0, 1, 2, 4]])


@pytest.mark.parametrize(("side", "mirrored"), [("right", False), ("left", False), ("left", True)])
def test_on_another_hand_the_file_s_joints_are_the_points(tmp_path: Path, side: Side, mirrored: bool) -> None:
    clip = make_clip(arrays_of(side), side)
    output = flat(network_output(clip))
    if mirrored:
        output["pred_keypoints_3d"] = output["pred_keypoints_3d"] * [-1, 1, 1]
    np.savez(tmp_path / "a.npz", **output)
    loaded = load(tmp_path / "a.npz", focal=clip.focal)
    assert codes(loaded) == {"tracks.joints_only"}
    assert loaded.tracks.template != "builtin"  # the fit aligns its own shape and poses
    np.testing.assert_allclose(loaded.tracks.landmarks2d, clip.pixels(), atol=0.01)
    seen = loaded.tracks.joints3d - loaded.tracks.joints3d.mean(1, keepdims=True)
    np.testing.assert_allclose(seen, clip.local - clip.local.mean(1, keepdims=True), atol=1e-5)


@pytest.mark.parametrize("side", ["right", "left"])
def test_on_another_hand_mano_s_joints_are_the_points(tmp_path: Path, mano: Path, side: Side) -> None:
    clip = make_clip(arrays_of(side), side)
    np.savez(tmp_path / "a.npz", **flat(network_output(clip, joints=False)))
    loaded = load(f"{tmp_path / 'a.npz'},mano={mano}", focal=clip.focal)
    assert codes(loaded) == {"tracks.joints_only"}
    np.testing.assert_allclose(loaded.tracks.landmarks2d, clip.pixels(), atol=0.01)


@pytest.mark.parametrize("side", ["right", "left"])
def test_without_joints_or_mano_the_rotations_carry_over(tmp_path: Path, side: Side) -> None:
    clip = make_clip(arrays_of(side), side)
    np.savez(tmp_path / "a.npz", **flat(network_output(clip, joints=False)))
    loaded = load(tmp_path / "a.npz", focal=clip.focal)
    assert codes(loaded) == {"tracks.rotations_only"}
    check(loaded, BUILTIN, clip.pose, loaded.tracks.landmarks2d.astype(np.float64))
    assert not loaded.tracks.pose.betas.any()
    # MANO's own wrist is not in the file: the mean hand's is used, some millimetres off.
    off = np.linalg.norm(loaded.tracks.landmarks2d[:, 0] - clip.pixels()[:, 0], axis=-1)
    assert off.max() < 0.01 * clip.focal / clip.transl[:, 2].min()


def test_joints_that_are_not_those_of_the_parameters_win(tmp_path: Path, template: Template) -> None:
    clip = make_clip(arrays_of("right"))
    output = flat(network_output(clip))
    output["hand_pose"] = output["hand_pose"].transpose(0, 1, 3, 2)
    np.savez(tmp_path / "a.npz", **output)
    loaded = load(tmp_path / "a.npz", template, focal=clip.focal)
    assert "tracks.parameters_differ" in codes(loaded)
    assert loaded.tracks.template != template.name
    np.testing.assert_allclose(loaded.tracks.landmarks2d, clip.pixels(), atol=0.01)


def test_frames_are_counted_from_the_first(tmp_path: Path, template: Template) -> None:
    clip = make_clip(arrays_of("right"))
    output = flat(network_output(clip))
    output["img_name"] = np.array([f"take3_{row + 1:04d}.png" for row in range(5)])
    np.savez(tmp_path / "a.npz", **output)
    known = load(tmp_path / "a.npz", template, frames=5)  # picture 5 is a fifth frame only from 1
    assert (known.tracks.indices, codes(known)) == ([0, 1, 2, 3, 4], set())
    unknown = load(tmp_path / "a.npz", template, frames=9)
    assert (unknown.tracks.indices, codes(unknown)) == ([1, 2, 3, 4, 5], {"tracks.offset_assumed"})
    told = load(f"{tmp_path / 'a.npz'},offset=3", template, frames=9)
    assert told.tracks.indices == [0, 1, 2]
    with pytest.raises(EngineError, match=r"tracks\.other_video"):
        load(f"{tmp_path / 'a.npz'},offset=40", template, frames=9)


def test_smaller_pictures_of_the_same_video(tmp_path: Path, template: Template) -> None:
    clip = make_clip(arrays_of("right"))
    np.savez(tmp_path / "a.npz", **flat(network_output(clip)))
    loaded = load(tmp_path / "a.npz", template, size=(1280, 960), focal=2 * clip.focal)
    check(loaded, template, clip.pose, 2 * clip.pixels())
    with pytest.raises(EngineError, match=r"tracks\.other_video"):
        load(tmp_path / "a.npz", template, size=(960, 1280))


@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("undistorted", [False, True])
def test_arctic_comes_back(tmp_path: Path, template: Template, side: Side, undistorted: bool) -> None:
    poses: dict[Side, Array] = {"right": make_clip(arrays_of("right")).pose}
    poses["left"] = make_clip(arrays_of("left"), "left", seed=9).pose
    arrays: dict[Side, dict[str, Any]] = {"right": arrays_of("right"), "left": arrays_of("left")}
    path, seen, camera = write_arctic(tmp_path, arrays, poses)
    straight = {**camera, "dist8": np.zeros(8)}
    pixels = (bent(seen[side], straight if undistorted else camera) + 0.5) * 0.3
    text = f"{path},undistorted=yes" if undistorted else str(path)
    loaded = load(text, template, side, size=(840, 600))
    tracks = loaded.tracks
    assert loaded.camera_known
    np.testing.assert_allclose(tracks.K[:2, 2], [(1390.5) * 0.3, 1003.5 * 0.3], rtol=1e-6)
    np.testing.assert_allclose(tracks.landmarks2d, pixels, atol=0.01)
    np.testing.assert_allclose(tracks.pose.hand_pose, poses[side][:, 3:], atol=1e-5)
    if undistorted:
        model = template.model(side)
        np.testing.assert_allclose(model.joints(tracks.pose), seen[side], atol=1e-4)
        assert codes(loaded) == {"tracks.offset_assumed"}
    else:
        assert codes(loaded) == {"tracks.offset_assumed", "tracks.distortion"}
        off = project(template.model(side).joints(tracks.pose).double().numpy(), tracks.K.double().numpy())
        assert np.median(np.linalg.norm(off - pixels, axis=-1)) < 1.0  # the lens bends them by 5


def test_arctic_s_rows_and_pictures(tmp_path: Path, mano: Path) -> None:
    arrays: dict[Side, dict[str, Any]] = {"right": arrays_of("right")}
    path, _, _ = write_arctic(tmp_path, arrays, {"right": make_clip(arrays["right"], frames=6).pose}, ahead=3)
    text = f"{path},mano={mano}"
    assert load(text, size=(2800, 2000)).tracks.indices == [2, 3, 4, 5, 6, 7]  # picture 1 is row -2
    pictures = tmp_path / "images" / "s01" / "box_grab_01" / "0"
    pictures.mkdir(parents=True)
    for number in (5, 6, 7):
        (pictures / f"{number:05d}.jpg").touch()
    assert load(text, size=(2800, 2000)).tracks.indices == [0, 1, 2, 3]
    assert load(f"{text},offset=1", size=(2800, 2000)).tracks.indices == [0, 1, 2, 3, 4]
    with pytest.raises(EngineError, match=r"tracks\.no_hand"):
        load(text, side="left", size=(2800, 2000))
    with pytest.raises(EngineError, match=r"tracks\.needs_mano"):
        load(path, size=(2800, 2000))
    with pytest.raises(EngineError, match=r"tracks\.other_video"):
        load(text, size=(2000, 2000))
    path.with_name("box_grab_01.egocam.dist.npy").unlink()
    with pytest.raises(EngineError, match=r"tracks\.incomplete"):
        load(text, size=(2800, 2000))


def test_arctic_s_hand_is_the_one_in_the_picture(tmp_path: Path, template: Template) -> None:
    arrays: dict[Side, dict[str, Any]] = {"right": arrays_of("right"), "left": arrays_of("left")}
    poses: dict[Side, Array] = {name: make_clip(arrays[name], name).pose for name in ("right", "left")}
    path, _, _ = write_arctic(tmp_path, arrays, poses)
    assert load(path, template, size=(2800, 2000)).tracks.pose.side == "right"
    hands = np.load(path, allow_pickle=True).item()
    hands["right"]["trans"] += 5  # metres
    np.save(path, np.array(hands, object), allow_pickle=True)
    assert load(path, template, size=(2800, 2000)).tracks.pose.side == "left"
    with pytest.raises(EngineError, match=r"tracks\.other_video"):
        load(path, template, "right", size=(2800, 2000))


def test_arctic_s_hands_outside_the_picture_are_left_out(tmp_path: Path, template: Template) -> None:
    arrays: dict[Side, dict[str, Any]] = {"right": arrays_of("right")}
    path, _, _ = write_arctic(tmp_path, arrays, {"right": make_clip(arrays["right"], frames=4).pose})
    camera = np.load(path.with_name("box_grab_01.egocam.dist.npy"), allow_pickle=True).item()
    camera["T_k_cam_np"][1, 0] += 2.0  # to the right
    camera["T_k_cam_np"][2, 2] -= 3.0  # behind
    np.save(path.with_name("box_grab_01.egocam.dist.npy"), np.array(camera, object), allow_pickle=True)
    loaded = load(path, template, size=(2800, 2000))
    assert loaded.tracks.indices == [0, 3]
    assert "tracks.frames_dropped" in codes(loaded)


def test_harp_comes_back(tmp_path: Path, template: Template) -> None:
    pose = make_clip(arrays_of("right")).pose
    pixels, _ = write_harp(tmp_path / "1" / "metro_mano", arrays_of("right"), pose)
    for text in (tmp_path / "1", tmp_path / "1" / "metro_mano", f"harp:{tmp_path / '1' / 'metro_mano'}"):
        loaded = load(text, template, size=(448, 448), focal=2000.0)
        assert not codes(loaded)
        check(loaded, template, pose, pixels)
    with pytest.raises(EngineError, match=r"tracks\.no_hand"):
        load(tmp_path / "1", template, "left", size=(448, 448))
    twice = load(tmp_path / "1", template, size=(896, 896), focal=4000.0)
    check(twice, template, pose, 2 * pixels)


def test_harp_without_mano_has_its_joints_or_nothing(tmp_path: Path, mano: Path) -> None:
    pose = make_clip(arrays_of("right")).pose
    pixels, _ = write_harp(tmp_path / "a", arrays_of("right"), pose)
    loaded = load(tmp_path / "a", size=(448, 448))
    assert codes(loaded) == {"tracks.joints_only"}
    np.testing.assert_allclose(loaded.tracks.landmarks2d, pixels, atol=0.01)
    pixels, _ = write_harp(tmp_path / "b", arrays_of("right"), pose, joints=False)
    with pytest.raises(EngineError, match=r"tracks\.needs_mano"):
        load(tmp_path / "b", size=(448, 448))
    loaded = load(f"{tmp_path / 'b'},mano={mano}", size=(448, 448))
    np.testing.assert_allclose(loaded.tracks.landmarks2d, pixels, atol=0.01)


def test_our_own_tracks_for_another_camera(tmp_path: Path) -> None:
    model = BUILTIN.hand.mirrored()
    made = own_tracks()
    pose = replace(
        made.pose, betas=0 * made.pose.betas, transl=made.pose.transl * 0.05 + torch.tensor([0.0, 0, 0.6])
    )
    made = replace(made, pose=pose, joints3d=model.joints(pose).numpy())
    write_tracks([made], tmp_path / "tracks.json")
    same = load(f"tracks:{tmp_path / 'tracks.json'}")
    torch.testing.assert_close(same.tracks.pose.transl, pose.transl, atol=1e-5, rtol=0)
    assert same.camera_known
    told = load(tmp_path / "tracks.json", focal=1000.0)
    before = project(made.joints3d.astype(np.float64), made.K.double().numpy())
    after = project(model.joints(told.tracks.pose).double().numpy(), told.tracks.K.double().numpy())
    assert (told.tracks.pose.transl[:, 2] > 1.5 * pose.transl[:, 2]).all()
    assert np.median(np.linalg.norm(after - before, axis=-1)) < 12  # perspective is another


def test_mirroring_is_what_the_networks_see() -> None:
    """The writer's own rule: mirrored points are those of the mirrored axis-angles."""
    right, left = arrays_of("right"), arrays_of("left")
    clip = make_clip(right)
    mirrored = Clip("left", clip.pose * MIRROR, clip.betas, clip.transl, clip.local * [-1, 1, 1])
    from tests.engine.tracking.import_files import points21

    for row in range(5):
        np.testing.assert_allclose(
            points21(left, clip.betas, mirrored.pose[row]), mirrored.local[row], atol=1e-12
        )
