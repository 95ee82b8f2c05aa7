"""ARCTIC (Fan et al. 2023): the egocentric view of a sequence, ``raw_seqs/<subject>/<sequence>.mano.npy``.

The file holds both hands in the world: rot [F,3], pose [F,45] relative to MANO's mean pose, trans [F,3],
shape [10] or [F,10]. Beside it ``.egocam.dist.npy`` has the camera, R_k_cam_np [F,3,3], T_k_cam_np [F,3,1],
intrinsics [3,3] for pictures of 2800x2000, and the lens dist8 [8]. ``meta/misc.json`` two folders up has
ioi_offset, what the pictures are numbered ahead of the rows.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from mass_engine.errors import EngineError
from mass_engine.hand.pose import Side
from mass_engine.tracking.imports.hand_track import (
    HandTrack,
    Kinematics,
    Note,
    image_scale,
    invalid,
    no_hand,
    numbers,
)
from mass_engine.tracking.imports.values import read_values

#: The pictures the intrinsics are for.
_SIZE = (2800.0, 2000.0)


def is_arctic(values: Any) -> bool:
    """Whether it holds hands as ARCTIC does."""
    return isinstance(values, Mapping) and any(
        isinstance(values.get(side), Mapping) and {"rot", "pose", "trans", "shape"} <= values[side].keys()
        for side in ("left", "right")
    )


def read_arctic(
    values: Any,
    path: Path,
    side: str,
    size: tuple[int, int],
    mano: Kinematics | None,
    *,
    undistorted: bool,
) -> list[HandTrack]:
    """The hand of ``side`` (auto: every hand, right first) of the file ``path`` that holds ``values``.

    ``numbers`` count rows. Raises EngineError ``tracks.needs_mano``, ``tracks.incomplete``,
    ``tracks.invalid``, ``tracks.no_hand``, ``tracks.other_video``.
    """
    if mano is None:
        raise EngineError(
            "tracks.needs_mano",
            "ARCTIC's poses are relative to MANO's mean pose.",
            "Give MANO, as ,mano=MANO_RIGHT.pkl after the file or as --template mano:MANO_RIGHT.pkl.",
        )
    if not is_arctic(values):
        raise invalid("there are no hands with rot, pose, trans and shape")
    held = [name for name in ("right", "left") if isinstance(values.get(name), Mapping)]
    if side != "auto" and side not in held:
        raise no_hand(side)
    wanted = held if side == "auto" else [side]
    return [_hand(values, path, cast("Side", name), size, mano, undistorted) for name in wanted]


def _hand(
    values: Any, path: Path, chosen: Side, size: tuple[int, int], mano: Kinematics, undistorted: bool
) -> HandTrack:
    hand = values[chosen]
    if not {"rot", "pose", "trans", "shape"} <= hand.keys():
        raise invalid(f"the {chosen} hand lacks rot, pose, trans or shape")
    rot = numbers(hand["rot"], "rot", (-1, 3))
    count = len(rot)
    pose = numbers(hand["pose"], "pose", (count, 45)) + mano.mean_pose(chosen)
    trans = numbers(hand["trans"], "trans", (count, 3))
    betas = np.broadcast_to(numbers(hand["shape"], "shape", (10,), (count, 10)), (count, 10))
    turn, shift, K, lens = _camera(path, count)
    zoom = image_scale(_SIZE, size)
    K = K * np.array([[zoom], [zoom], [1.0]])
    finite = np.ones(count, bool)
    for part in (rot, pose, trans, betas, turn.reshape(count, 9), shift):
        finite &= np.isfinite(part).all(1)
    notes: list[Note] = []
    if not finite.all():
        notes.append(
            (
                "tracks.frames_dropped",
                f"{int((~finite).sum())} frames without finite numbers left out.",
                "Look at the result with care.",
            )
        )
    if not finite.any():
        raise invalid("no frame holds finite numbers")
    # The wrist, about which the hand is turned, at rest: world to camera turns about the world's origin.
    model = mano.model(chosen)
    offsets = torch.tensor(np.nan_to_num(betas)) @ model.joint_shape_basis[0].T
    wrist = (model.joint_template[0] + offsets).numpy()
    orient = (
        Rotation.from_matrix(_eye_where(turn, ~finite)) * Rotation.from_rotvec(np.nan_to_num(rot))
    ).as_rotvec()
    transl = np.einsum("fij,fj->fi", turn, wrist + trans) + shift - wrist
    track = HandTrack(
        chosen,
        list(range(count)),
        orient,
        pose,
        np.array(betas),
        transl,
        np.ones(count),
        K,
        distortion=None if undistorted or not lens.any() else lens,
        real=True,
        notes=tuple(notes),
    )
    return track.rows(finite)


def picture_offset(path: Path) -> tuple[int, Note]:
    """Which row the first picture shows, and what that was concluded from."""
    root, sid = path.parent.parent.parent, path.parent.name
    sequence = path.name.removesuffix(".npy").removesuffix(".mano")
    advice = "If the video starts elsewhere, give ,offset=N: the row that its first frame shows."
    try:
        ahead = int(json.loads((root / "meta" / "misc.json").read_text())[sid]["ioi_offset"])
    except (OSError, ValueError, KeyError, TypeError):
        return 0, (
            "tracks.offset_assumed",
            "There is no meta/misc.json with ioi_offset: the video is taken to start at the first row.",
            advice,
        )
    pictures = root / "images" / sid / sequence / "0"
    found = [int(file.stem) for file in pictures.glob("*.jpg") if re.fullmatch(r"\d+", file.stem)]
    first = min(found, default=1)
    return first - ahead, (
        "tracks.offset_assumed",
        f"The video is taken to start at picture {first:05d}, which is row {first - ahead}.",
        advice,
    )


def _eye_where(turn: Any, bad: Any) -> Any:
    return np.where(bad[:, None, None], np.eye(3), turn)


def _camera(path: Path, count: int) -> tuple[Any, Any, Any, Any]:
    """World-to-camera rotations [F,3,3] and shifts [F,3], K [3,3] and the lens [8] of the file beside it."""
    beside = path.with_name(path.name.removesuffix(".npy").removesuffix(".mano") + ".egocam.dist.npy")
    if not beside.is_file():
        raise EngineError(
            "tracks.incomplete",
            f"There is no {beside.name} beside {path.name}, so its camera is not known.",
            "Put the sequence's camera file into the same folder.",
        )
    camera = read_values(beside)
    names = ("R_k_cam_np", "T_k_cam_np", "intrinsics", "dist8")
    if not isinstance(camera, Mapping) or any(name not in camera for name in names):
        raise invalid(f"{beside.name} lacks one of {', '.join(names)}")
    turn = numbers(camera["R_k_cam_np"], "R_k_cam_np", (count, 3, 3))
    shift = numbers(camera["T_k_cam_np"], "T_k_cam_np", (count, 3, 1), (count, 3)).reshape(count, 3)
    K = numbers(camera["intrinsics"], "intrinsics", (3, 3)).copy()
    lens = numbers(camera["dist8"], "dist8", (8,), (8, 1), (1, 8)).ravel()
    if not (np.isfinite(K).all() and np.isfinite(lens).all() and K[0, 0] > 0 and K[1, 1] > 0):
        raise invalid(f"{beside.name} holds no camera")
    K[2] = (0, 0, 1)
    K[:2, 2] += 0.5  # a calibration by OpenCV has pixel centres at whole numbers
    return turn, shift, K, lens
