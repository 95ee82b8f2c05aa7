"""What every import becomes first: one hand's poses as the other program and its camera see them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from mass_engine.errors import EngineError
from mass_engine.hand.mano import ManoFile
from mass_engine.hand.model import HandModel, mirror_pose
from mass_engine.hand.pose import HandPose, Side

Array = NDArray[np.float64]

#: (code, message, advice) of a warning.
Note = tuple[str, str, str]


@dataclass(frozen=True)
class HandTrack:
    """F rows of one hand in MANO's conventions, in the axes of its camera (x right, y down, z forward).

    ``numbers`` [F] as the file counts frames; ``orient`` [F,3] and ``fingers`` [F,45] axis-angles of the
    hand's own side; ``betas`` [F,10]; ``transl`` [F,3] metres; ``scores`` [F]. ``joints`` [F,21,3] metres in
    our order, before ``transl``, where the file has them. ``flat``: ``fingers`` are relative to the flat hand
    (else to MANO's mean pose, and no MANO file was at hand to add it).

    ``mirrored``: whoever saved the file may have left ``joints`` as those of the mirrored hand.
    ``other_transl`` [F,3]: where the hand is if its crop's camera was left so; then ``centres`` [F,2] says
    in which pixel the hand's middle was found.

    ``K`` [3,3] is the camera these were made for, in pixels of the video, pixel centres at +0.5;
    ``real`` says that it is the video's own, not one that the other program assumes; ``distortion`` [8] its
    lens in OpenCV's rational model. ``counted``: the file names its frames, it does not only line them up.
    """

    side: Side
    numbers: list[int]
    orient: Array
    fingers: Array
    betas: Array
    transl: Array
    scores: Array
    K: Array
    joints: Array | None = None
    mirrored: bool = False
    other_transl: Array | None = None
    centres: Array | None = None
    distortion: Array | None = None
    real: bool = False
    flat: bool = True
    counted: bool = False
    notes: tuple[Note, ...] = ()

    def rows(self, keep: NDArray[np.bool_]) -> HandTrack:
        """The rows where ``keep`` [F] is true."""

        def kept(part: Array | None) -> Array | None:
            return None if part is None else part[keep]

        return replace(
            self,
            numbers=[number for number, wanted in zip(self.numbers, keep, strict=True) if wanted],
            orient=self.orient[keep],
            fingers=self.fingers[keep],
            betas=self.betas[keep],
            transl=self.transl[keep],
            scores=self.scores[keep],
            joints=kept(self.joints),
            other_transl=kept(self.other_transl),
            centres=kept(self.centres),
        )

    def pose(self) -> HandPose:
        """The same as a batched pose."""
        parts = [
            torch.tensor(part, dtype=torch.float64)
            for part in (self.betas, self.orient, self.fingers, self.transl)
        ]
        return HandPose(parts[0], parts[1], parts[2], parts[3], self.side)


@dataclass(frozen=True)
class Kinematics:
    """Somebody's MANO: ``file`` for its mean pose, ``hand`` (of the file's side) for its joints."""

    file: ManoFile
    hand: HandModel

    def model(self, side: Side) -> HandModel:
        """The hand of ``side`` in float64."""
        hand = self.hand if self.hand.side == side else self.hand.mirrored()
        return hand.to("cpu", torch.float64)

    def mean_pose(self, side: Side) -> Array:
        """The mean finger pose [45] of ``side``."""
        mean = torch.from_numpy(self.file.hands_mean)
        return (mean if side == self.file.side else mirror_pose(mean)).numpy()


def numbers(value: object, name: str, *shapes: tuple[int, ...]) -> Array:
    """``value`` as float64 of one of ``shapes`` (-1: any length). Raises EngineError ``tracks.invalid``."""
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError) as error:
        raise invalid(f"{name} is not made of numbers") from error
    for shape in shapes:
        if len(shape) == array.ndim and all(
            want in (-1, size) for want, size in zip(shape, array.shape, strict=True)
        ):
            return array
    wanted = " or ".join(str([size if size >= 0 else "F" for size in shape]) for shape in shapes)
    raise invalid(f"{name} has shape {list(array.shape)}, not {wanted}")


def invalid(problem: str) -> EngineError:
    """The error for a file that is readable, but not what it should be."""
    return EngineError(
        "tracks.invalid", f"The tracks cannot be used: {problem}.", "See the README on what each kind holds."
    )


def no_hand(side: str) -> EngineError:
    """The error for the wrong side."""
    return EngineError("tracks.no_hand", f"The tracks hold no {side} hand.", "Choose the other --side.")


def image_scale(made_for: tuple[float, float], size: tuple[int, int]) -> float:
    """Pixels of the video per pixel of the pictures the poses are for; both (width, height).

    Raises EngineError ``tracks.other_video`` when they are not the same picture.
    """
    scale = size[0] / made_for[0]
    if abs(made_for[1] * scale - size[1]) > max(2.0, 0.01 * size[1]):
        raise EngineError(
            "tracks.other_video",
            f"The tracks are for {made_for[0]:.0f}x{made_for[1]:.0f}, the video is {size[0]}x{size[1]}.",
            "Give the whole video the poses are of, uncropped.",
        )
    return scale
