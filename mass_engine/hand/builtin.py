"""The built-in hand: loaded from a small data file that :mod:`mass_engine.hand.sculpt` makes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor

from mass_engine.hand.model import HandModel
from mass_engine.hand.pose import Side

DATA_FILE = Path(__file__).parent / "data" / "builtin.safetensors"

#: The point each of the 15 finger joints' segments ends at.
_SEGMENT_END = (2, 3, 17, 5, 6, 18, 8, 9, 20, 11, 12, 19, 14, 15, 16)
#: Where the thumb's tip goes as the thumb bends: into the palm, towards the little finger (right hand).
_THUMB_BENDS_TO = (0.0, -0.6, -0.8)

#: (least, greatest) angle in degrees about each joint's flexion, abduction and twist axes, knuckle outwards.
#: After the ranges of motion in Hume et al. (1990) and Bain et al. (2015); fingers do not twist of their own.
_FINGER_LIMITS = (
    ((-30, 95), (-22, 22), (-10, 10)),
    ((-5, 115), (-4, 4), (-5, 5)),
    ((-15, 85), (-3, 3), (-5, 5)),
)
_THUMB_LIMITS = (
    ((-40, 55), (-40, 40), (-30, 30)),
    ((-20, 60), (-12, 12), (-10, 10)),
    ((-30, 90), (-5, 5), (-6, 6)),
)


def load_builtin(side: Side) -> HandModel:
    """The built-in hand of ``side``; the left one is the right one mirrored."""
    tensors = load_file(DATA_FILE)
    tensors["faces"] = tensors["faces"].long()
    bends = tensors.pop("bend_shapes")
    right = HandModel.from_tensors("right", tensors)
    right = replace(right, pose_basis=_bend_basis(bends, joint_frames(right)[:, 0]))
    return right if side == "right" else right.mirrored()


def _bend_basis(bends: Tensor, axes: Tensor) -> Tensor:
    """[V,3,135] from the shapes [V,3,15,2] of sin(a) and 1 - cos(a) about each joint's flexion axis [15,3].

    Both are linear in a rotation R: sin(a) along an axis is half of R - R^T there, 1 - cos(a) is half of what
    the diagonal of R lacks, whatever the axis.
    """
    flexes, turns = bends.unbind(-1)
    x, y, z = (0.5 * axes).T
    zero = torch.zeros_like(x)
    of_sine = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1)
    of_cosine = torch.zeros(15, 9)
    of_cosine[:, [0, 4, 8]] = -0.5
    basis: Tensor = flexes.unsqueeze(-1) * of_sine + turns.unsqueeze(-1) * of_cosine
    return basis.flatten(2)


def joint_limits() -> Tensor:
    """[15,3,2] radians: least and greatest flexion, abduction and twist of each finger joint, either side."""
    rows = [*_FINGER_LIMITS * 4, *_THUMB_LIMITS]
    return torch.deg2rad(torch.tensor(rows, dtype=torch.float32))


def joint_frames(model: HandModel) -> Tensor:
    """[15,3,3]: rows are each finger joint's flexion, abduction and twist axes at rest.

    The dot product of a joint's axis-angle with a row is its angle about that axis (exact for one axis
    alone). Positive flexion closes the hand, positive abduction moves a finger towards the thumb, the twist
    axis points along the finger.
    """
    # Angles are the same on both sides when the left axes are the right ones mirrored as rotations are.
    right = model if model.side == "right" else model.mirrored()
    points = right.joint_template
    along = torch.nn.functional.normalize(points[list(_SEGMENT_END)] - points[1:16], dim=-1)
    bend = torch.tensor([0.0, 0.0, 1.0]).repeat(15, 1)
    bend[12:] = torch.linalg.cross(along[12:], torch.tensor(_THUMB_BENDS_TO).expand(3, 3))
    bend = torch.nn.functional.normalize(bend - along * (bend * along).sum(-1, keepdim=True), dim=-1)
    frames = torch.stack([bend, torch.linalg.cross(along, bend), along], 1)
    return frames if model.side == "right" else frames * torch.tensor([1.0, -1.0, -1.0])
