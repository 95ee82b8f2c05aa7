"""How the skin moves when a joint turns: the analytic Jacobian that Gauss-Newton steps need."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from mass_engine.fitting.subject import Shape
from mass_engine.hand.pose import JOINT_PARENTS, HandPose
from mass_engine.hand.rotation import axis_angle_to_matrix, matrix_to_axis_angle
from mass_engine.surfel.subdivision import Subdivision

#: Numbers of one frame's pose: three small rotations for the wrist and each finger joint, a translation.
POSE_SIZE = 51


@dataclass(frozen=True)
class PoseJacobian:
    """Posed ``vertices`` [B,V,3] of a refined mesh, and what their derivatives are made of.

    ``swept`` [B,V,16,3]: the part of a vertex that joint j carries, about that joint; ``parents``
    [B,16,3,3]: the frame each joint's small rotation is given in; ``turns`` [B,V,3,3]: the blended rotation
    of the skin, which carries an offset of the rest surface.
    """

    vertices: Tensor
    swept: Tensor
    parents: Tensor
    turns: Tensor

    def of(self, row: int) -> Tensor:
        """d vertices / d (16 small rotations in their parents' frames, translation): [V,3,51].

        A joint that turns by the world vector w moves what it carries by w x swept.
        """
        s = self.swept[row]
        zero = torch.zeros_like(s[..., 0])
        cross = torch.stack(
            [zero, s[..., 2], -s[..., 1], -s[..., 2], zero, s[..., 0], s[..., 1], -s[..., 0], zero], -1
        ).unflatten(-1, (3, 3))
        turned = torch.einsum("vjab,jbc->vajc", cross, self.parents[row]).flatten(2)
        eye = torch.eye(3).expand(len(turned), 3, 3)
        return torch.cat([turned, eye], -1)


def pose_jacobian(shape: Shape, subdivision: Subdivision, pose: HandPose) -> PoseJacobian:
    """Linearise the refined mesh of poses [B]. Pose correctives are posed but not differentiated."""
    model = shape.model
    with torch.no_grad():
        posed = model.posed(pose, shape.displacement)
        transforms = posed.bone_transforms
        turns, places = transforms[..., :3, :3], posed.joints[:, :16]
        blended = torch.einsum("vj,bjac->bvac", model.weights, turns)
        # A vertex is sum_k w_k (turn_k x + shift_k): x is found back from it, correctives included.
        shift = torch.einsum("vj,bja->bva", model.weights, transforms[..., :3, 3])
        rest = torch.linalg.solve(blended, (posed.vertices - shift).unsqueeze(-1)).squeeze(-1)
        each = torch.einsum("bjac,bvc->bvja", turns, rest) + transforms[:, None, :, :3, 3]
        each = each * model.weights.unsqueeze(-1)
        below = _descendants()
        carried = torch.einsum("jk,bvka->bvja", below, each)
        weight = torch.einsum("jk,vk->vj", below, model.weights)
        swept = carried - weight[..., None] * places[:, None]
        count = len(model.template)
        values = torch.cat([posed.vertices, swept.flatten(2), blended.flatten(2)], -1)
        refined = subdivision.apply(values.reshape(-1, count, values.shape[-1]))
        parents = turns[:, [max(parent, 0) for parent in JOINT_PARENTS]].clone()
        parents[:, 0] = torch.eye(3)
    return PoseJacobian(
        refined[..., :3],
        refined[..., 3:51].unflatten(-1, (16, 3)),
        parents,
        refined[..., 51:].unflatten(-1, (3, 3)),
    )


def shape_jacobian(shape: Shape, subdivision: Subdivision, pose: HandPose, step: float = 0.05) -> Tensor:
    """d refined vertices / d betas [B,V,3,10] by central differences (the mesh is almost linear in them)."""
    columns = []
    with torch.no_grad():
        for number in range(10):
            ends = []
            for sign in (step, -step):
                betas = pose.betas.clone()
                betas[:, number] += sign
                moved = HandPose(betas, pose.global_orient, pose.hand_pose, pose.transl, pose.side)
                ends.append(shape.model.posed(moved, shape.displacement).vertices)
            columns.append(subdivision.apply(ends[0] - ends[1]) / (2 * step))
    return torch.stack(columns, -1)


def turned(pose: HandPose, step: Tensor) -> HandPose:
    """``pose`` [B] after a step [B,51] of small rotations (each in its parent's frame) and a translation."""
    vectors = torch.cat([pose.global_orient, pose.hand_pose], -1).unflatten(-1, (16, 3))
    small = step[:, :48].unflatten(-1, (16, 3))
    new = matrix_to_axis_angle(axis_angle_to_matrix(small) @ axis_angle_to_matrix(vectors))
    return HandPose(pose.betas, new[:, 0], new[:, 1:].flatten(1), pose.transl + step[:, 48:], pose.side)


def _descendants() -> Tensor:
    """[16,16]: one where joint k moves with joint j (itself included)."""
    below = torch.eye(16)
    for joint in range(15, 0, -1):
        below[JOINT_PARENTS[joint]] += below[joint]
    return below
