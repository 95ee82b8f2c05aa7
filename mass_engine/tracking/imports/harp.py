"""HARP (Karunratanakul et al. 2023): a folder of ``%04d_mano.pkl``, one a picture of 448x448.

rot [1,3], pose [1,45] relative to MANO's mean pose, shape [1,10], trans [1,3] metres, cam (s, tx, ty), and
joints [1,21,3] in millimetres. The renderer's camera has a focal length of 2000 pixels and, in PyTorch3D's
axes (x left, y up), T = (-tx, -ty, 2 * 2000 / (448 s)): a shift by (tx, ty, ...) in ours. Hands are right.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from mass_engine.tracking.imports.hand_track import (
    Array,
    HandTrack,
    Kinematics,
    Note,
    image_scale,
    invalid,
    no_hand,
    numbers,
)
from mass_engine.tracking.imports.values import name_numbers
from mass_engine.tracking.landmarks import NETWORK_ORDER

FOCAL, SIZE = 2000.0, 448.0
_NAMES = ("rot", "pose", "shape", "trans", "cam")


def is_harp(values: Any) -> bool:
    """Whether it is one frame as HARP has it, or a dictionary of such frames by file name."""
    if not isinstance(values, Mapping):
        return False
    if all(name in values for name in _NAMES):
        return True
    parts = list(values.values())
    return bool(parts) and all(isinstance(part, Mapping) and set(_NAMES) <= part.keys() for part in parts)


def read_harp(values: Any, side: str, size: tuple[int, int], mano: Kinematics | None) -> HandTrack:
    """The clip's track. Raises EngineError ``tracks.invalid``, ``tracks.no_hand``, ``tracks.other_video``."""
    if not is_harp(values):
        raise invalid(f"its frames lack one of {', '.join(_NAMES)}")
    if side == "left":
        raise no_hand(side)
    frames: Mapping[str, Any] = {"0": values} if "rot" in values else values
    zoom = image_scale((SIZE, SIZE), size)
    counts = name_numbers([str(name) for name in frames])
    columns: dict[str, list[Array]] = {name: [] for name in (*_NAMES, "joints")}
    whole = True
    for frame in frames.values():
        for name, width in zip(_NAMES, (3, 45, 10, 3, 3), strict=True):
            columns[name].append(_row(frame[name], name, width))
        joints = np.asarray(frame["joints"]) if "joints" in frame else np.zeros(0)
        whole = whole and joints.size == 63
        columns["joints"].append(_row(joints, "joints", 63) if joints.size == 63 else np.zeros(63))
    rot, pose, shape, trans, cam, flat_joints = (np.stack(column) for column in columns.values())
    finite = np.isfinite(np.concatenate([rot, pose, shape, trans, cam, flat_joints], 1)).all(1)
    finite &= cam[:, 0] > 0
    if not finite.any():
        raise invalid("no frame holds finite numbers and a camera")
    joints = flat_joints.reshape(-1, 21, 3)[:, list(NETWORK_ORDER)]
    if whole and np.median(np.abs(joints[finite][:, 4] - joints[finite][:, 0]).max(-1)) > 1:
        joints = joints / 1000  # millimetres
    notes: list[Note] = []
    if not finite.all():
        notes.append(
            (
                "tracks.frames_dropped",
                f"{int((~finite).sum())} frames without finite numbers left out.",
                "Look at the result with care.",
            )
        )
    depth = 2 * FOCAL / (SIZE * np.where(finite, cam[:, 0], 1.0))
    shift = np.stack([cam[:, 1], cam[:, 2], depth], 1)
    focal = FOCAL * zoom
    order = np.argsort(counts if counts is not None else range(len(rot)), kind="stable")
    return HandTrack(
        "right",
        [counts[row] if counts is not None else int(row) for row in order],
        rot[order],
        (pose if mano is None else pose + mano.mean_pose("right"))[order],
        shape[order],
        (trans + shift)[order],
        np.ones(len(rot)),
        np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1.0]]),
        joints=(joints - trans[:, None])[order] if whole else None,
        flat=mano is not None,
        counted=counts is not None,
        notes=tuple(notes),
    ).rows(finite[order])


def _row(value: object, name: str, width: int) -> Array:
    try:
        array = np.asarray(value, np.float64).ravel()
    except (TypeError, ValueError) as error:
        raise invalid(f"{name} is not made of numbers") from error
    return numbers(array, name, (width,))
