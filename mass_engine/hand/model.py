"""The hand model every stage shares: shape blend, pose correctives, linear blend skinning."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from mass_engine.errors import EngineError
from mass_engine.hand.pose import TIP_PARENTS, HandPose, Side
from mass_engine.hand.rotation import axis_angle_to_matrix as axis_angle_to_matrix

_KNUCKLES = (1, 4, 7, 10, 13)
_MIDDLE = (2, 5, 8, 11, 14)
_LAST = (3, 6, 9, 12, 15)
#: Chain order (three levels of five) back to joint order.
_FROM_LEVELS = (0, 1, 6, 11, 2, 7, 12, 3, 8, 13, 4, 9, 14, 5, 10, 15)

_REQUIRED = (
    "template", "faces", "shape_basis", "joint_template", "joint_shape_basis", "weights",
)  # fmt: skip


@dataclass(frozen=True)
class PosedHand:
    """A hand in a pose: ``vertices`` [...,V,3], ``joints`` [...,21,3] in metres, and
    ``bone_transforms`` [...,16,4,4].

    ``bone_transforms`` take a point of the shaped rest hand to where that bone carries it.
    """

    vertices: Tensor
    joints: Tensor
    bone_transforms: Tensor

    def moved(self, shift: Tensor) -> PosedHand:
        """The hand elsewhere: as if ``shift`` [...,3] had been added to the pose's ``transl``."""
        offset = torch.nn.functional.pad(shift[..., None, :, None], (3, 0, 0, 1))  # [...,1,4,4]
        return PosedHand(
            self.vertices + shift.unsqueeze(-2),
            self.joints + shift.unsqueeze(-2),
            self.bone_transforms + offset,
        )


@dataclass(frozen=True)
class HandModel:
    """A skinned parametric hand; MANO's joint order, frame and pose conventions; metres, float32.

    ``template`` [V,3]; ``faces`` [F,3] int64, counter-clockwise seen from outside; ``shape_basis``
    [V,3,10]; ``joint_template`` [21,3] (16 joints, 5 tips, at rest, mean shape); ``joint_shape_basis``
    [21,3,10]; ``weights`` [V,16], rows sum to one; ``pose_basis`` [V,3,135] or None multiplies the
    flattened R - I of the 15 finger joints.

    ``global_orient`` turns the hand about its wrist joint, ``transl`` is added last
    (Romero et al. 2017, Embodied Hands, section 3).
    """

    side: Side
    template: Tensor
    faces: Tensor
    shape_basis: Tensor
    joint_template: Tensor
    joint_shape_basis: Tensor
    weights: Tensor
    pose_basis: Tensor | None = None

    @staticmethod
    def from_tensors(side: Side, tensors: Mapping[str, Tensor]) -> HandModel:
        """The model whose :meth:`tensors` these are. Raises KeyError when one is missing."""
        required = {name: tensors[name] for name in _REQUIRED}
        return HandModel(side, **required, pose_basis=tensors.get("pose_basis"))

    def tensors(self) -> dict[str, Tensor]:
        """Everything but the side, by name, for a file."""
        result = {name: getattr(self, name) for name in _REQUIRED}
        return result if self.pose_basis is None else {**result, "pose_basis": self.pose_basis}

    def __call__(self, pose: HandPose) -> tuple[Tensor, Tensor]:
        """Vertices [...,V,3] and joints [...,21,3] of ``pose``; differentiable, any leading dimensions."""
        hand = self.posed(pose)
        return hand.vertices, hand.joints

    def joints(self, pose: HandPose) -> Tensor:
        """The 21 points [...,21,3] of ``pose`` alone, without any vertex."""
        return self.skeleton(pose)[0]

    def skeleton(self, pose: HandPose) -> tuple[Tensor, Tensor]:
        """The 21 points [...,21,3] and the rotations [...,16,3,3] of the bones from rest, no vertex."""
        self._check(pose)
        rest = self._rest_joints(pose.betas)
        turns, places = _chain(_local_rotations(pose), rest)
        return _points(turns, places, rest) + pose.transl.unsqueeze(-2), turns

    def posed(self, pose: HandPose, offsets: Tensor | None = None) -> PosedHand:
        """Pose the hand; ``offsets`` [V,3] or [...,V,3] metres move the rest vertices before skinning."""
        self._check(pose)
        rest = self._rest_joints(pose.betas)
        shaped = self.template + _combine(self.shape_basis, pose.betas)
        if offsets is not None:
            shaped = shaped + offsets
        rotations = _local_rotations(pose)
        if self.pose_basis is not None:
            bend = (
                rotations[..., 1:, :, :] - torch.eye(3, dtype=rotations.dtype, device=rotations.device)
            ).flatten(-3)
            shaped = shaped + _combine(self.pose_basis, bend)
        turns, places = _chain(rotations, rest)
        shifts = places - (turns @ rest[..., :16, :].unsqueeze(-1)).squeeze(-1) + pose.transl.unsqueeze(-2)
        blended = self.weights @ torch.cat((turns.flatten(-2), shifts), -1)
        turn = blended[..., :9].reshape(*blended.shape[:-1], 3, 3)
        turned = (turn * shaped.unsqueeze(-2)).sum(-1)
        points = _points(turns, places, rest) + pose.transl.unsqueeze(-2)
        upper = torch.cat((turns, shifts.unsqueeze(-1)), -1)
        lower = upper.new_zeros(4)
        lower[3] = 1.0
        lower = lower.expand(*upper.shape[:-2], 1, 4)
        return PosedHand(turned + blended[..., 9:], points, torch.cat((upper, lower), -2))

    def mirrored(self) -> HandModel:
        """The other hand: x negated, faces turned so that they still face outward."""
        flip = torch.tensor([-1.0, 1.0, 1.0]).to(self.template)
        pose_basis = None
        if self.pose_basis is not None:
            # Mirroring a rotation negates its x row and column, the corner twice.
            signs = (flip[:, None] * flip).flatten().repeat(15)
            pose_basis = self.pose_basis * flip[:, None] * signs
        return replace(
            self,
            side="left" if self.side == "right" else "right",
            template=self.template * flip,
            faces=self.faces.flip(-1),
            shape_basis=self.shape_basis * flip[:, None],
            joint_template=self.joint_template * flip,
            joint_shape_basis=self.joint_shape_basis * flip[:, None],
            pose_basis=pose_basis,
        )

    def to(self, device: torch.device | str, dtype: torch.dtype | None = None) -> HandModel:
        """The same model elsewhere; ``dtype`` changes the floating-point tensors only."""
        moved = {
            name: value.to(device=device, dtype=dtype if value.is_floating_point() else None)
            for name, value in self.tensors().items()
        }
        return HandModel.from_tensors(self.side, moved)

    def _rest_joints(self, betas: Tensor) -> Tensor:
        return self.joint_template + _combine(self.joint_shape_basis, betas)

    def _check(self, pose: HandPose) -> None:
        sizes = {"betas": 10, "global_orient": 3, "hand_pose": 45, "transl": 3}
        for name, size in sizes.items():
            value: Tensor = getattr(pose, name)
            if value.shape[-1:] != (size,):
                raise EngineError(
                    "pose.shape",
                    f"{name} has shape {list(value.shape)}, its last dimension must be {size}.",
                    "Check the file or call the pose comes from.",
                )
        if pose.side != self.side:
            raise EngineError(
                "pose.side",
                f"A {pose.side} hand's pose was given to a {self.side} hand model.",
                "Load the model of the other side, or mirror the pose.",
            )


def mirror_pose(axis_angles: Tensor) -> Tensor:
    """Axis-angles [...,3 n] of one side to those of the other (mirrored in x: y and z change sign)."""
    turn = torch.tensor([1.0, -1.0, -1.0]).to(axis_angles)
    return axis_angles * turn.repeat(axis_angles.shape[-1] // 3)


def _combine(basis: Tensor, coefficients: Tensor) -> Tensor:
    """``basis`` [P,3,K] times ``coefficients`` [...,K] -> [...,P,3]."""
    moved = coefficients @ basis.flatten(0, 1).T
    return moved.reshape(*coefficients.shape[:-1], *basis.shape[:2])


def _local_rotations(pose: HandPose) -> Tensor:
    """[...,16,3,3]: the wrist's, then the 15 joints', each in its parent's frame."""
    wrist, fingers = pose.global_orient, pose.hand_pose
    if wrist.shape[:-1] != fingers.shape[:-1]:
        lead: tuple[int, ...] = np.broadcast_shapes(wrist.shape[:-1], fingers.shape[:-1])
        wrist, fingers = wrist.expand(*lead, 3), fingers.expand(*lead, 45)
    vectors = torch.cat((wrist, fingers), -1)
    return axis_angle_to_matrix(vectors.reshape(*vectors.shape[:-1], 16, 3))


@functools.cache
def _index(joints: tuple[int, ...], device: torch.device) -> Tensor:
    """Made once: indexing with a list copies it to the device each time, which waits for the device."""
    return torch.tensor(joints, device=device)


def _chain(rotations: Tensor, rest: Tensor) -> tuple[Tensor, Tensor]:
    """Absolute rotations [...,16,3,3] and joint places [...,16,3]; all five fingers a level at a time."""
    lead: tuple[int, ...] = np.broadcast_shapes(rotations.shape[:-3], rest.shape[:-2])
    turn = rotations[..., :1, :, :].expand(*lead, 1, 3, 3)
    place = rest[..., :1, :].expand(*lead, 1, 3)
    turns, places = [turn], [place]
    device = rest.device
    knuckles, middle, last = (_index(level, device) for level in (_KNUCKLES, _MIDDLE, _LAST))
    parents = [_index((0,), device), knuckles, middle]
    for level, parent in zip((knuckles, middle, last), parents, strict=True):
        step = rest[..., level, :] - rest[..., parent, :]
        place = place + (turn @ step.unsqueeze(-1)).squeeze(-1)
        turn = turn @ rotations[..., level, :, :]
        turns.append(turn)
        places.append(place)
    order = _index(_FROM_LEVELS, device)
    return torch.cat(turns, -3)[..., order, :, :], torch.cat(places, -2)[..., order, :]


def _points(turns: Tensor, places: Tensor, rest: Tensor) -> Tensor:
    """The 16 joints and 5 fingertips [...,21,3]."""
    parent = _index(TIP_PARENTS, rest.device)
    arm = (rest[..., 16:, :] - rest[..., parent, :]).unsqueeze(-1)
    tips = places[..., parent, :] + (turns[..., parent, :, :] @ arm).squeeze(-1)
    return torch.cat((places, tips), -2)
