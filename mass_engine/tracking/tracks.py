"""tracks.json: the poses of a clip in one readable file; every fit writes it, ``--tracks`` takes it."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mass_engine.errors import EngineError
from mass_engine.hand.pose import HandPose, Side

_ADVICE = "Give a tracks.json as `mass-engine fit` writes it, for the same video."


@dataclass(frozen=True)
class Tracks:
    """One hand in F frames: ``indices``, ``times`` [F], ``pose`` batched, ``joints3d`` [F,21,3] camera
    metres, ``landmarks2d`` [F,21,2] pixels, ``scores`` [F]; ``K`` [3,3] for pictures of ``size`` (w, h).

    ``template`` names the hand that the poses, and above all ``betas``, are of. ``at_joints``: the
    ``landmarks2d`` are joints of a hand model, not what a tracker saw in the picture. ``rotations``: those
    of ``pose`` are about a flat hand's, so that an alignment of any template can begin with them.
    """

    video: str
    fps: float
    size: tuple[int, int]
    K: Tensor
    indices: list[int]
    times: list[float]
    pose: HandPose
    joints3d: NDArray[np.float32]
    landmarks2d: NDArray[np.float32]
    scores: list[float]
    template: str = "builtin"
    at_joints: bool = False
    rotations: bool = True


def write_tracks(tracks: Sequence[Tracks], path: Path) -> None:
    """Write the tracks of one or two hands of a clip, seen by one camera, as tracks.json in one step."""
    frames: dict[int, dict[str, Any]] = {}
    for one in tracks:
        for row, (index, time) in enumerate(zip(one.indices, one.times, strict=True)):
            hand = {
                "side": one.pose.side,
                "betas": _rounded(one.pose.betas[row]),
                "global_orient": _rounded(one.pose.global_orient[row]),
                "hand_pose": _rounded(one.pose.hand_pose[row]),
                "transl": _rounded(one.pose.transl[row]),
                "joints3d": _rounded(one.joints3d[row]),
                "landmarks2d": _rounded(one.landmarks2d[row], 3),
                "score": round(one.scores[row], 4),
            }
            frame = frames.setdefault(index, {"index": index, "time": round(time, 6), "hands": []})
            frame["hands"].append(hand)
    first = tracks[0]
    data = {
        "video": first.video,
        "fps": round(first.fps, 4),
        "width": first.size[0],
        "height": first.size[1],
        "K": _rounded(first.K, 4),
        "template": first.template,
        "landmarks_at_joints": first.at_joints,
        "frames": [frames[index] for index in sorted(frames)],
    }
    partial = path.with_name(path.name + ".partial")
    partial.write_text(json.dumps(data) + "\n")
    os.replace(partial, path)


def read_tracks(path: Path, side: str, size: tuple[int, int]) -> Tracks:
    """Read the hand of ``side`` (auto: the one in most frames) for a video of ``size`` (width, height).

    Raises EngineError ``tracks.not_found``, ``tracks.invalid``, ``tracks.other_video``.
    """
    try:
        data = json.loads(path.read_text())
    except OSError as error:
        raise EngineError("tracks.not_found", f"{path} cannot be read.", _ADVICE) from error
    except ValueError as error:
        raise EngineError("tracks.invalid", f"{path.name} is not JSON.", _ADVICE) from error
    try:
        return _parse(data, side, size)
    except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
        raise EngineError("tracks.invalid", f"{path.name} is not complete: {error!r}.", _ADVICE) from error


def _parse(data: dict[str, Any], side: str, size: tuple[int, int]) -> Tracks:
    if (int(data["width"]), int(data["height"])) != size:
        raise EngineError(
            "tracks.other_video",
            f"The tracks are for {data['width']}x{data['height']}, the video is {size[0]}x{size[1]}.",
            _ADVICE,
        )
    rows = [(frame, hand) for frame in data["frames"] for hand in frame["hands"]]
    counts = {name: sum(hand["side"] == name for _, hand in rows) for name in ("left", "right")}
    chosen = max(counts, key=lambda name: counts[name]) if side == "auto" else side
    rows = sorted(
        ((frame, hand) for frame, hand in rows if hand["side"] == chosen),
        key=lambda row: int(row[0]["index"]),
    )
    if not rows:
        raise EngineError("tracks.no_hand", f"The tracks hold no {chosen} hand.", "Choose the other --side.")

    def column(name: str, shape: tuple[int, ...]) -> Tensor:
        return torch.from_numpy(np.stack([_array(hand[name], shape) for _, hand in rows]))

    return Tracks(
        str(data["video"]),
        float(data["fps"]),
        size,
        torch.from_numpy(_array(data["K"], (3, 3))),
        [int(frame["index"]) for frame, _ in rows],
        [float(frame["time"]) for frame, _ in rows],
        HandPose(
            column("betas", (10,)),
            column("global_orient", (3,)),
            column("hand_pose", (45,)),
            column("transl", (3,)),
            cast("Side", chosen),
        ),
        column("joints3d", (21, 3)).numpy(),
        column("landmarks2d", (21, 2)).numpy(),
        [min(1.0, max(0.0, float(hand["score"]))) for _, hand in rows],
        str(data.get("template", "builtin")),
        bool(data.get("landmarks_at_joints", False)),
    )


def _array(value: object, shape: tuple[int, ...]) -> NDArray[np.float32]:
    array = np.asarray(value, dtype=np.float32)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"expected finite numbers of shape {shape}, not {array.shape}")
    return array


def _rounded(value: Tensor | NDArray[np.float32] | Sequence[float], digits: int = 6) -> Any:
    array = np.asarray(value, dtype=np.float64)
    if not math.isfinite(float(np.abs(array).sum())):
        raise ValueError("tracks hold numbers that are not finite")
    return np.round(array, digits).tolist()
