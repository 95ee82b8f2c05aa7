"""The hand model every stage shares: shape blend, pose correctives, linear blend skinning."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from mass_engine.errors import EngineError
from mass_engine.hand.pose import TIP_PARENTS, HandPose, Side
from mass_engine.hand.rotation import rodrigues

_KNUCKLES = [1, 4, 7, 10, 13]
_MIDDLE = [2, 5, 8, 11, 14]
_LAST = [3, 6, 9, 12, 15]
#: Chain order (three levels of five) back to joint order.
_FROM_LEVELS = [0, 1, 6, 11, 2, 7, 12, 3, 8, 13, 4, 9, 14, 5, 10, 15]


@dataclass(frozen=True)
class PosedHand:
    """A hand in a pose: ``vertices`` [...,V,3], ``joints`` [...,21,3] in metres, and ``bones`` [...,16,4,4].

    ``bones`` take a point of the shaped rest hand to where that bone carries it.
    """

    vertices: Tensor
    joints: Tensor
    bones: Tensor


@dataclass(frozen=True)
class HandModel:
    """A skinned parametric hand; MANO's joint order, frame and pose conventions; metres, float32.

    ``template`` [V,3]; ``faces`` [F,3] int64, counter-clockwise seen from outside; ``shape_basis``
    [V,3,10]; ``joint_template`` [21,3] (16 joints, 5 tips, at rest, mean shape); ``joint_shape_basis``
    [21,3,10]; ``weights`` [V,16], rows sum to one; ``pose_basis`` [V,3,135] or None multiplies the
    flattened R - I of the 15 finger joints; ``cap_faces`` [C] int64 are the faces closing the wrist;
    ``joint_frames`` [15,3,3]: columns are each joint's flexion, abduction and twist axes at rest;
    ``joint_limits`` [15,3,2]: least and greatest radians about them.

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
    cap_faces: Tensor
    joint_frames: Tensor
    joint_limits: Tensor
    pose_basis: Tensor | None = None

    @property
    def wrist_vertices(self) -> Tensor:
        """Indices [K] of the vertices that belong to the wrist cap."""
        return self.faces[self.cap_faces].flatten().unique()

    def __call__(self, pose: HandPose) -> tuple[Tensor, Tensor]:
        """Vertices [...,V,3] and joints [...,21,3] of ``pose``; differentiable, any leading dimensions."""
        hand = self.posed(pose)
        return hand.vertices, hand.joints

    def joints(self, pose: HandPose) -> Tensor:
        """The 21 points [...,21,3] of ``pose`` alone, without any vertex."""
        self._check(pose)
        rest = self._rest_joints(pose.betas)
        turns, places = _chain(_local_rotations(pose), rest)
        return _points(turns, places, rest) + pose.transl.unsqueeze(-2)

    def posed(self, pose: HandPose, offsets: Tensor | None = None) -> PosedHand:
        """Pose the hand; ``offsets`` [V,3] or [...,V,3] metres move the rest vertices before skinning."""
        self._check(pose)
        rest = self._rest_joints(pose.betas)
        shaped = self.template + (self.shape_basis.flatten(0, 1) @ pose.betas.unsqueeze(-1)).unflatten(
            -2, self.template.shape
        ).squeeze(-1)
        if offsets is not None:
            shaped = shaped + offsets
        rotations = _local_rotations(pose)
        if self.pose_basis is not None:
            bend = (rotations[..., 1:, :, :] - torch.eye(3).to(rotations)).flatten(-3)
            moved = bend @ self.pose_basis.flatten(0, 1).T
            shaped = shaped + moved.unflatten(-1, self.template.shape)
        turns, places = _chain(rotations, rest)
        shifts = places - (turns @ rest[..., :16, :].unsqueeze(-1)).squeeze(-1) + pose.transl.unsqueeze(-2)
        blended = self.weights @ torch.cat((turns.flatten(-2), shifts), -1)
        turned = (blended[..., :9].unflatten(-1, (3, 3)) @ shaped.unsqueeze(-1)).squeeze(-1)
        points = _points(turns, places, rest) + pose.transl.unsqueeze(-2)
        upper = torch.cat((turns, shifts.unsqueeze(-1)), -1)
        lower = torch.tensor([0.0, 0.0, 0.0, 1.0]).to(upper).expand(*upper.shape[:-2], 1, 4)
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
            # An axis is a pseudo-vector: mirrored and negated.
            joint_frames=self.joint_frames * -flip[:, None],
            pose_basis=pose_basis,
        )

    def to(self, device: torch.device | str, dtype: torch.dtype | None = None) -> HandModel:
        """The same model elsewhere; ``dtype`` changes the floating-point tensors only."""
        moved = {
            name: value.to(device=device, dtype=dtype if value.is_floating_point() else None)
            for name, value in vars(self).items()
            if isinstance(value, Tensor)
        }
        return replace(self, **moved)

    def _rest_joints(self, betas: Tensor) -> Tensor:
        moved = self.joint_shape_basis.flatten(0, 1) @ betas.unsqueeze(-1)
        return self.joint_template + moved.unflatten(-2, self.joint_template.shape).squeeze(-1)

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


def mirrored_pose(pose: HandPose) -> HandPose:
    """The pose of the other hand that looks like ``pose`` in a mirror across the plane x = 0."""
    turn = torch.tensor([1.0, -1.0, -1.0]).to(pose.transl)
    return HandPose(
        betas=pose.betas,
        global_orient=pose.global_orient * turn,
        hand_pose=(pose.hand_pose.unflatten(-1, (15, 3)) * turn).flatten(-2),
        transl=pose.transl * -turn,
        side="left" if pose.side == "right" else "right",
    )


def _local_rotations(pose: HandPose) -> Tensor:
    """[...,16,3,3]: the wrist's, then the 15 joints', each in its parent's frame."""
    lead = torch.broadcast_shapes(pose.global_orient.shape[:-1], pose.hand_pose.shape[:-1])
    wrist = pose.global_orient.expand(*lead, 3).unsqueeze(-2)
    fingers = pose.hand_pose.expand(*lead, 45).unflatten(-1, (15, 3))
    return rodrigues(torch.cat((wrist, fingers), -2))


def _chain(rotations: Tensor, rest: Tensor) -> tuple[Tensor, Tensor]:
    """Absolute rotations [...,16,3,3] and joint places [...,16,3]; all five fingers a level at a time."""
    lead = torch.broadcast_shapes(rotations.shape[:-3], rest.shape[:-2])
    turn = rotations[..., :1, :, :].expand(*lead, 1, 3, 3)
    place = rest[..., :1, :].expand(*lead, 1, 3)
    turns, places = [turn], [place]
    parents: list[list[int]] = [[0], _KNUCKLES, _MIDDLE]
    for level, parent in zip((_KNUCKLES, _MIDDLE, _LAST), parents, strict=True):
        step = rest[..., level, :] - rest[..., parent, :]
        place = place + (turn @ step.unsqueeze(-1)).squeeze(-1)
        turn = turn @ rotations[..., level, :, :]
        turns.append(turn)
        places.append(place)
    return torch.cat(turns, -3)[..., _FROM_LEVELS, :, :], torch.cat(places, -2)[..., _FROM_LEVELS, :]


def _points(turns: Tensor, places: Tensor, rest: Tensor) -> Tensor:
    """The 16 joints and 5 fingertips [...,21,3]."""
    parent = list(TIP_PARENTS)
    arm = (rest[..., 16:, :] - rest[..., parent, :]).unsqueeze(-1)
    tips = places[..., parent, :] + (turns[..., parent, :, :] @ arm).squeeze(-1)
    return torch.cat((places, tips), -2)
