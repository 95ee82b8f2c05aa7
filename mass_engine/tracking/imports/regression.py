"""WiLoR (Potamias et al. 2025) and HaMeR (Pavlakos et al. 2024), which share their conventions.

Neither has a file format of its own; people save the dictionaries of the networks and of the demos. Taken are
those names, in one file for the clip or one a frame, in any nesting of dictionaries and lists.

Both networks know right hands only and see a left one in a mirrored crop: rotation *matrices* are the mirror
hand's. Axis-angles are of the hand's own side, as WiLoR-mini gives them. Rotations are absolute: zero is the
flat hand. The camera is weak, (s, tx, ty) in the crop, or ``pred_cam_t_full`` for a focal length of
5000 / 256 times the longer image side.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
from scipy.spatial.transform import Rotation

from mass_engine.hand.pose import Side
from mass_engine.tracking.imports.hand_track import (
    Array,
    HandTrack,
    Note,
    image_scale,
    invalid,
    no_hand,
)
from mass_engine.tracking.imports.values import name_numbers
from mass_engine.tracking.landmarks import NETWORK_ORDER

#: Focal length in crops of this size that both networks assume.
FOCAL, CROP = 5000.0, 256.0

_CONTAINERS = ("wilor_preds", "hamer_preds", "out", "pred_mano_params", "mano_params")
_HAND = ("hand_pose",)
_SIDE = ("right", "is_right", "handedness", "side", "hand_side")
_CAM_T = ("pred_cam_t_full", "cam_t_full", "cam_t", "camera_translation")
_SIZE = ("img_size", "full_img_size")
_JOINTS = ("pred_keypoints_3d", "keypoints_3d")
_FRAME = (
    "frame", "frames", "frame_id", "frame_ids", "frame_idx", "frame_index", "frame_number",
    "img_name", "img_names", "imgname", "img_path", "image_name", "image_path", "frame_names", "names",
)  # fmt: skip
_SCORE = ("score", "scores", "conf", "confidence", "det_conf")
#: A matrix further than this from a rotation is not one (half precision is not further than 0.002).
_NO_ROTATION = 0.02


@dataclass
class _Row:
    """One hand in one frame, as written."""

    number: int
    right: bool
    rotations: Array  # [16,3,3] of the hand's own side
    betas: Array
    camera: Array | None  # translation in the full picture
    weak: Array | None  # (s, tx, ty)
    box: Array | None  # centre x, y and side, pixels
    size: Array | None  # width, height
    focal: float | None
    joints: Array | None  # about the hand's own origin, on either side
    score: float


@dataclass
class _Found:
    rows: list[_Row] = field(default_factory=list)
    assumed: Side = "right"  # of hands without a side
    assumptions: int = 0
    broken: int = 0  # rows that hold NaN
    counted: bool = False


def is_regression(values: Any) -> bool:
    """Whether there is a hand pose anywhere in it."""
    if isinstance(values, Mapping):
        return any(name in values for name in _HAND) or any(is_regression(part) for part in values.values())
    return isinstance(values, list) and any(is_regression(part) for part in values)


def read_regression(values: Any, side: str, size: tuple[int, int]) -> HandTrack:
    """One hand's track out of what a file (or a folder: a dictionary by file name) holds.

    ``side`` auto: the hand in more frames. ``size`` (width, height) of the video. Raises EngineError
    ``tracks.invalid``, ``tracks.no_hand``, ``tracks.other_video``.
    """
    found = _Found(assumed="left" if side == "left" else "right")
    _walk(values, None, None, found)
    if not found.rows:
        raise invalid(f"no frame holds a hand ({found.broken} hold numbers that are not finite)")
    notes: list[Note] = []
    if found.broken:
        notes.append(
            (
                "tracks.frames_dropped",
                f"{found.broken} hands without finite numbers left out.",
                "Look at the result with care.",
            )
        )
    if found.assumptions:
        notes.append(
            (
                "tracks.side_assumed",
                f"The file does not say whose hands these are: taken as {found.assumed}.",
                "Give --side, or save the entry `right` with the hands.",
            )
        )
    chosen, rows = _choose(found.rows, side)
    sizes = {tuple(row.size.tolist()) for row in rows if row.size is not None}
    if len(sizes) > 1:
        raise invalid("its frames are of several sizes")
    made_for = np.array(sizes.pop() if sizes else size, np.float64)
    if not (made_for > 0).all():
        raise invalid("the size of its pictures is not positive")
    zoom = image_scale((float(made_for[0]), float(made_for[1])), size)
    focals = [row.focal for row in rows if row.focal is not None]
    focal = float(np.median(focals)) if focals else FOCAL / CROP * float(made_for.max())
    if not 0 < focal < 1e7:
        raise invalid("its focal length is not positive")
    transl, other, centres = _translations(rows, made_for, focal)
    K = np.array([[focal * zoom, 0, size[0] / 2], [0, focal * zoom, size[1] / 2], [0, 0, 1.0]])
    rotations = Rotation.from_matrix(np.stack([row.rotations for row in rows]).reshape(-1, 3, 3))
    vectors = rotations.as_rotvec().reshape(len(rows), 48)
    return HandTrack(
        chosen,
        [row.number for row in rows],
        vectors[:, :3],
        vectors[:, 3:],
        np.stack([row.betas for row in rows]),
        transl,
        np.array([row.score for row in rows]),
        K,
        joints=_joints(rows),
        mirrored=chosen == "left",
        other_transl=other if chosen == "left" else None,
        centres=None if centres is None else centres * zoom,
        counted=found.counted,
        notes=tuple(notes),
    )


def _walk(part: Any, number: int | None, right: bool | None, found: _Found) -> None:
    """Collect every hand below ``part``, of frame ``number`` and side ``right`` where they are known."""
    if isinstance(part, list):
        for place, item in enumerate(part):
            _walk(item, place if number is None else number, right, found)
    elif isinstance(part, Mapping):
        flat = _flat(part)
        if any(name in flat for name in _HAND):
            _block(flat, number, right, found)
            return
        named = [
            name for name in part if isinstance(part[name], Mapping | list) and is_regression(part[name])
        ]
        sides = {"left": False, "right": True}
        counts = name_numbers([str(name) for name in named]) if number is None else None
        if counts is not None:
            found.counted = True
        for place, name in enumerate(named):
            _walk(
                part[name],
                number if counts is None else counts[place],
                sides.get(str(name).lower(), right),
                found,
            )


def _flat(part: Mapping[Any, Any]) -> dict[str, Any]:
    """The entries of a hand, those of the dictionaries in it that networks nest them in included."""
    result = {str(name): value for name, value in part.items()}
    for name in _CONTAINERS:
        if isinstance(result.get(name), Mapping):
            result.update(_flat(result.pop(name)))
    return result


def _block(flat: dict[str, Any], number: int | None, right: bool | None, found: _Found) -> None:
    """A batch of hands: of several frames when it is not known to be of one, else all of that one."""
    fingers, matrices = _rotations(flat["hand_pose"], 15)
    count = len(fingers)
    if "global_orient" not in flat:
        raise invalid("hand_pose comes without global_orient")
    orient, _ = _rotations(flat["global_orient"], 1, matrices)
    if len(orient) != count:
        raise invalid(f"global_orient is for {len(orient)} hands, hand_pose for {count}")
    names = next((flat[name] for name in _FRAME if flat.get(name) is not None), None)
    counts = None if names is None else _counts(names, count)
    if counts is not None:
        found.counted = True
    elif number is not None:
        counts = [number] * count
    else:
        counts = list(range(count))
    sides = _sides(flat, count, right, found)

    def column(aliases: Sequence[str], width: int) -> Array | None:
        value = next((flat[name] for name in aliases if flat.get(name) is not None), None)
        return None if value is None else _rows(value, count, width, aliases[0])

    betas = column(("betas",), 10)
    camera, weak, size = column(_CAM_T, 3), column(("pred_cam",), 3), column(_SIZE, 2)
    centre, side_length = column(("box_center",), 2), column(("box_size",), 1)
    box = None if centre is None or side_length is None else np.concatenate([centre, side_length], 1)
    focal, score = column(("scaled_focal_length",), 1), column(_SCORE, 1)
    joints = column(_JOINTS, 63)
    for row in range(count):
        rotations = np.concatenate([orient[row], fingers[row]])
        needed = [rotations, *(part[row] for part in (betas, camera, weak, box) if part is not None)]
        if not all(np.isfinite(part).all() for part in needed):
            found.broken += 1
            continue
        rotations = _true_rotations(rotations)
        if matrices and not sides[row]:
            rotations = rotations * _MIRROR
        found.rows.append(
            _Row(
                counts[row],
                sides[row],
                rotations,
                np.zeros(10) if betas is None else betas[row],
                None if camera is None else camera[row],
                None if weak is None else weak[row],
                None if box is None else box[row],
                None if size is None else size[row],
                None if focal is None else float(focal[row, 0]),
                None if joints is None else joints[row].reshape(21, 3)[list(NETWORK_ORDER)],
                1.0 if score is None else float(np.clip(np.nan_to_num(score[row, 0]), 0, 1)),
            )
        )


#: Mirroring a rotation in x changes the sign of its first row and column, the corner twice.
_MIRROR = np.outer([-1.0, 1.0, 1.0], [-1.0, 1.0, 1.0])


def _rotations(value: object, joints: int, matrices: bool | None = None) -> tuple[Array, bool]:
    """Matrices [B,joints,3,3] from matrices or axis-angles, and whether they came as matrices.

    ``matrices`` says which where the shape alone does not.
    """
    name = "global_orient" if joints == 1 else "hand_pose"
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError) as error:
        raise invalid(f"{name} is not made of numbers") from error
    if matrices is None:
        matrices = array.ndim >= 3 and array.shape[-2:] == (3, 3)
    if matrices and array.size and array.size % (9 * joints) == 0 and array.shape[-2:] == (3, 3):
        return array.reshape(-1, joints, 3, 3), True
    if not matrices and array.size and array.size % (3 * joints) == 0 and array.shape[-1] in (3, 3 * joints):
        vectors = array.reshape(-1, 3)
        turned = Rotation.from_rotvec(np.nan_to_num(vectors)).as_matrix()
        turned[~np.isfinite(vectors).all(1)] = np.nan
        return turned.reshape(-1, joints, 3, 3), False
    raise invalid(f"{name} has shape {list(array.shape)}, not [B,{joints},3,3] or [B,{3 * joints}]")


def _true_rotations(matrices: Array) -> Array:
    """The rotations nearest to [16,3,3]. Raises EngineError ``tracks.invalid`` when they are none."""
    left, _, right = np.linalg.svd(matrices)
    nearest = np.asarray(left @ right)
    if np.abs(nearest - matrices).max() > _NO_ROTATION or (np.linalg.det(nearest) < 0).any():
        raise invalid("its matrices are not rotations")
    return nearest


def _counts(names: Any, count: int) -> list[int] | None:
    """Frame numbers from what a file calls its frames: numbers, or names with numbers in them."""
    listed = names if isinstance(names, list) else np.asarray(names).ravel().tolist()
    if len(listed) == 1:
        listed = listed * count
    if len(listed) != count:
        return None
    if all(isinstance(name, str) for name in listed):
        return name_numbers(listed)
    if all(isinstance(name, int | float) and float(name).is_integer() for name in listed):
        return [int(name) for name in listed]
    return None


def _sides(flat: dict[str, Any], count: int, right: bool | None, found: _Found) -> list[bool]:
    value = next((flat[name] for name in _SIDE if flat.get(name) is not None), None)
    if value is None:
        found.assumptions += right is None
        return [found.assumed == "right" if right is None else right] * count
    words: list[Any] = value if isinstance(value, list) else np.asarray(value).ravel().tolist()
    if len(words) == 1:
        words = words * count
    if len(words) != count:
        raise invalid(f"sides are given for {len(words)} hands, poses for {count}")
    result: list[bool] = []
    for word in words:
        if isinstance(word, str) and word.lower()[:1] in ("l", "r"):
            result.append(word.lower()[0] == "r")
        elif isinstance(word, bool | int | float | np.generic):
            result.append(float(word) > 0.5)
        else:
            raise invalid(f"a side is called {str(word)[:20]!r}")
    return result


def _rows(value: object, count: int, width: int, name: str) -> Array:
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError) as error:
        raise invalid(f"{name} is not made of numbers") from error
    if array.size == count * width:
        return array.reshape(count, width)
    if array.size == width:
        return np.broadcast_to(array.reshape(1, width), (count, width))
    raise invalid(f"{name} has shape {list(array.shape)} for {count} hands")


def _choose(rows: list[_Row], side: str) -> tuple[Side, list[_Row]]:
    """The rows of one side in order, the most certain one of each frame."""
    counts = {
        name: len({row.number for row in rows if row.right == (name == "right")})
        for name in ("right", "left")
    }
    chosen = max(counts, key=lambda name: counts[name]) if side == "auto" else side
    best: dict[int, _Row] = {}
    for row in rows:
        if row.right == (chosen == "right") and (
            row.number not in best or row.score > best[row.number].score
        ):
            best[row.number] = row
    if not best:
        raise no_hand(chosen)
    return cast("Side", chosen), [best[number] for number in sorted(best)]


def _translations(rows: list[_Row], size: Array, focal: float) -> tuple[Array, Array | None, Array | None]:
    """Full-picture translations [F,3]: as given, else from the crops' weak cameras.

    Those also with the other sign of tx (the demos change that of left hands where it is stored, other
    people's programs do not), and with the crops' centres [F,2].
    """
    if all(row.camera is not None for row in rows):
        return np.stack([cast("Array", row.camera) for row in rows]), None, None
    if any(row.weak is None or row.box is None for row in rows):
        raise invalid("it needs pred_cam_t_full, or pred_cam with box_center and box_size")
    weak = np.stack([cast("Array", row.weak) for row in rows])
    box = np.stack([cast("Array", row.box) for row in rows])
    width = box[:, 2] * weak[:, 0]
    if (width <= 0).any():
        raise invalid("a weak camera's scale or a box is not positive")
    away = 2 * (box[:, :2] - size / 2) / width[:, None]
    result = np.stack([weak[:, 1] + away[:, 0], weak[:, 2] + away[:, 1], 2 * focal / width], 1)
    other = result.copy()
    other[:, 0] -= 2 * weak[:, 1]
    return result, other, box[:, :2]


def _joints(rows: list[_Row]) -> Array | None:
    if any(row.joints is None or not np.isfinite(row.joints).all() for row in rows):
        return None
    return np.stack([cast("Array", row.joints) for row in rows])
