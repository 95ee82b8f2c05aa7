"""Gauss-Newton over all frames: every pose from its own evidence, the shared surface from all of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from mass_engine.camera import Camera
from mass_engine.fitting.exposure import without
from mass_engine.fitting.kinematics import POSE_SIZE, pose_jacobian, shape_jacobian, turned
from mass_engine.fitting.light import LightSample, sample_colors, solve_light
from mass_engine.fitting.poses import PoseTable
from mass_engine.fitting.registration import (
    Evidence2D,
    RegistrationWeights,
    matrices,
    normal_equations,
    observe,
    observe_far,
    overlap,
    project_jacobian,
)
from mass_engine.fitting.subject import (
    Appearance,
    PosedSurfels,
    Shape,
    mesh_edges,
    render_row,
    vertex_normals,
)
from mass_engine.fitting.views import View
from mass_engine.hand.builtin import joint_frames, joint_limits
from mass_engine.hand.pose import HandPose
from mass_engine.hand.rotation import axis_angle_to_matrix, matrix_to_axis_angle
from mass_engine.raster import RasterOptions
from mass_engine.surfel.binding import MeshBinding
from mass_engine.surfel.shading import white_light
from mass_engine.surfel.subdivision import Subdivision
from mass_engine.tracking.alignment import hand_size_pixels, interpolate_pose
from mass_engine.tracking.offsets import tracked_points

#: Frames whose Jacobians are held at a time.
CHUNK = 12
#: Step of the differences that the landmarks' derivatives are, radians and metres.
DIFFERENCE = 1e-3


@dataclass(frozen=True)
class Priors:
    """Standard deviations of what a step may assume, in radians and metres."""

    trust: float = 0.05  # evidence of neighbouring pixels errs together: what one pixel counts
    finger_motion: float = 0.10  # against the mean of the neighbouring frames
    wrist_motion: float = 0.06
    shift_motion: float = 0.004
    limit: float = 0.03  # beyond a joint limit
    damping: float = 0.15  # largest usual step of an angle
    shift_damping: float = 0.01
    betas: float = 1.0
    offset: float = 0.008  # of the personal surface
    offset_bend: float = 0.0012  # between neighbouring vertices
    astray: float = 0.955  # a frame whose silhouettes overlap less has misplaced fingers: look far, too
    worse: float = 0.15  # a step that costs so much of the silhouettes' overlap was a leap: undone
    landmark_knee: float = 0.08  # from here on a point's error counts linearly, hand sizes


@dataclass(frozen=True)
class Round:
    """One Gauss-Newton step of every frame at a resolution."""

    side: int
    texture: bool = True
    betas: bool = True
    offsets: bool = True
    landmark: float = 0.08  # standard deviation of the tracker's points, hand sizes
    weights: RegistrationWeights = field(default_factory=RegistrationWeights)


class Registrar:
    """Steps of the rows of ``table`` and of ``shape``."""

    def __init__(
        self,
        views: list[View],
        table: PoseTable,
        shape: Shape,
        camera: Camera,
        raster: RasterOptions,
        priors: Priors | None = None,
        shading: bool = True,
    ) -> None:
        self.views, self.table, self.shape = views, table, shape
        self.camera, self.raster = camera, raster
        self.priors = priors or Priors()
        self.light, self._shading = white_light(), shading
        #: How much brighter each frame's colours are [F,3].
        self.gains = torch.ones(len(views), 3)
        #: Silhouette overlap [F] and poses [F,...] before each row's last step (overlap 0: none yet).
        self.memory = {"overlap": torch.zeros(len(views))}
        self.memory |= {name: value.clone() for name, value in table.values.items()}
        self.undone = 0
        self._limits, self._axes = joint_limits().double(), joint_frames(shape.model).double()
        self._edges = mesh_edges(shape.model.faces)
        self.trained = [row for row, view in enumerate(views) if not view.heldout]
        self._points = torch.stack([torch.from_numpy(view.points) for view in views])
        self._sizes = hand_size_pixels(self._points)
        self._at_joints = torch.tensor([view.at_joints for view in views])

    def step(
        self,
        stage: Round,
        binding: MeshBinding,
        appearance: Appearance,
        rows: list[int] | None = None,
        motion: bool = True,
    ) -> Tensor:
        """One step; returns the mean length of the evidence's pull in pixels of the level [B].

        Without ``rows`` all training rows and the shared surface move; with ``rows`` only their poses. A row
        whose silhouette has got clearly worse by its last step goes back to before it, and stays there.
        """
        shared = rows is None
        chosen = self.trained if rows is None else rows
        subdivision = binding.subdivision
        targets = self._between(chosen)
        if not motion:
            targets[1].zero_()
        vertices = subdivision.n_vertices
        systems: list[tuple[Tensor, Tensor, Tensor, Tensor, Tensor]] = []
        blocks, sides = torch.zeros(vertices, 3, 3), torch.zeros(vertices, 3)
        pulls: list[float] = []
        overlaps: list[float] = []
        lit: list[LightSample] = []
        for start in range(0, len(chosen), CHUNK):
            part = chosen[start : start + CHUNK]
            pose = self.poses(part)
            jacobian = pose_jacobian(self.shape, subdivision, pose)
            of_shape = shape_jacobian(self.shape, subdivision, pose) if shared and stage.betas else None
            with torch.no_grad():
                attached = binding.register(jacobian.vertices)
                hand = self.shape.model.posed(pose, self.shape.displacement)
            surfels = PosedSurfels(
                attached, jacobian.vertices, hand.bone_transforms[..., :3, :3], hand.joints
            )
            for place, row in enumerate(part):
                level = without(self.views[row].level(stage.side), self.gains[row])
                with torch.no_grad():
                    out = render_row(appearance, surfels, place, binding.bones, level.camera, self.raster)
                skin = jacobian.vertices[place]
                normals = vertex_normals(skin, subdivision.faces)
                evidence = observe(level, out, skin, normals, stage.weights, stage.texture)
                if shared and stage.texture:
                    usable = level.hand * level.colored
                    lit.append(sample_colors(level.rgb, usable, evidence.pixels, normals, evidence.seen))
                onto = project_jacobian(level, skin)
                j = onto @ jacobian.of(place)
                p = j.shape[-1]
                if of_shape is not None:
                    j = torch.cat([j, onto @ of_shape[place]], -1)
                a, b = normal_equations(evidence.hessian, evidence.gradient, j)
                covered = overlap(level, out.alpha)
                overlaps.append(covered)
                if covered < self.priors.astray:
                    away = observe_far(level, out.alpha, evidence.pixels, stage.weights)
                    far, draw = normal_equations(*away, j[..., :p])
                    a[:p, :p] += far
                    b[:p] += draw
                a, b = a * self.priors.trust, b * self.priors.trust
                systems.append((a[:p, :p], b[:p], a[p:, :p], a[p:, p:], b[p:]))
                pulls.append(_pull(evidence))
                if shared and stage.offsets:
                    lever = onto @ jacobian.turns[place]
                    h = matrices(evidence.hessian) @ lever
                    blocks += lever.mT @ h
                    sides += (lever.mT @ evidence.gradient.unsqueeze(-1)).squeeze(-1)
        steps, betas = self._solve(chosen, systems, targets, stage.landmark)
        self._move(chosen, self._step_back(chosen, steps, torch.tensor(overlaps)))
        if shared and stage.betas:
            self.shape.betas += betas.clamp(-0.5, 0.5).float()
        if shared and stage.offsets:
            self._move_surface(subdivision, blocks, sides)
        if lit and self._shading:
            self.light = solve_light(lit, vertices)
        return torch.tensor(pulls)

    def _step_back(self, rows: list[int], steps: Tensor, overlaps: Tensor) -> Tensor:
        """Undo the last step of the rows that it made worse; the others' steps [B,51] stand."""
        index = torch.tensor(rows)
        worse = overlaps < self.memory["overlap"][index] - self.priors.worse
        for name, value in self.table.values.items():
            before = value[index].clone()
            value[index[worse]] = self.memory[name][index[worse]]
            self.memory[name][index[~worse]] = before[~worse]
        self.memory["overlap"][index[~worse]] = overlaps[~worse]
        self.undone += int(worse.sum())
        return torch.where(worse.unsqueeze(-1), torch.zeros_like(steps), steps)

    def forget(self, rows: list[int]) -> None:
        """Rows that were placed anew have no last step."""
        self.memory["overlap"][torch.tensor(rows, dtype=torch.long)] = 0.0

    def poses(self, rows: list[int]) -> HandPose:
        """The rows' poses as they stand (batched)."""
        index = torch.tensor(rows)
        leaves = {name: value[index] for name, value in self.table.values.items()}
        return self.table.pose(self.shape.betas, leaves)

    def _between(self, rows: list[int]) -> tuple[Tensor, Tensor]:
        """How each row would have to turn [B,51] to lie between its training neighbours, and how near
        these are [B] (1 at 30 frames a second, 0 at an end)."""
        targets, near = (
            torch.zeros(len(rows), POSE_SIZE, dtype=torch.float64),
            torch.zeros(len(rows), dtype=torch.float64),
        )
        for place, row in enumerate(rows):
            earlier = [other for other in self.trained if other < row][-1:]
            later = [other for other in self.trained if other > row][:1]
            if not earlier or not later:
                continue
            pair = self.poses(earlier + later)
            times = [self.views[earlier[0]].time, self.views[later[0]].time]
            middle = interpolate_pose(pair, times, [self.views[row].time])
            own = self.poses([row])
            for name, columns in (("global_orient", slice(0, 3)), ("hand_pose", slice(3, 48))):
                goal = axis_angle_to_matrix(getattr(middle, name).double().view(-1, 3))
                here = axis_angle_to_matrix(getattr(own, name).double().view(-1, 3))
                targets[place, columns] = matrix_to_axis_angle(goal @ here.mT).flatten()
            targets[place, 48:] = (middle.transl - own.transl)[0].double()
            near[place] = min(1.0, ((times[1] - times[0]) * 15) ** -2)
        return targets, near

    def _solve(
        self,
        rows: list[int],
        systems: list[tuple[Tensor, Tensor, Tensor, Tensor, Tensor]],
        targets: tuple[Tensor, Tensor],
        landmark: float,
    ) -> tuple[Tensor, Tensor]:
        """Steps [B,51] of the poses and [10] of the shape: the poses are eliminated first (Schur)."""
        p = self.priors
        motion = torch.cat(
            [
                torch.full((3,), p.wrist_motion),
                torch.full((45,), p.finger_motion),
                torch.full((3,), p.shift_motion),
            ]
        ).double()
        damping = torch.cat([torch.full((48,), p.damping), torch.full((3,), p.shift_damping)]).double()
        pull, near = targets
        limit, limit_side = self._limit_terms(rows)
        mark, mark_side = self._landmark_terms(rows, landmark)
        own = torch.stack([a for a, *_ in systems]) + limit + mark
        side = torch.stack([b for _, b, *_ in systems]) + limit_side + mark_side
        weight = near.unsqueeze(-1) / motion.square()
        own = own + torch.diag_embed(weight + damping**-2)
        side = side + weight * pull
        cross = torch.stack([c for _, _, c, _, _ in systems])
        if cross.shape[1] == 0:
            return torch.linalg.solve(own, side.unsqueeze(-1)).squeeze(-1), torch.zeros(0)
        shape = torch.stack([d for *_, d, _ in systems]).sum(0)
        shape_side = torch.stack([e for *_, e in systems]).sum(0)
        shape = shape + torch.eye(10).double() * (p.betas**-2 + 0.3**-2)
        shape_side = shape_side - self.shape.betas.double() * p.betas**-2
        solved = torch.linalg.solve(own, torch.cat([cross.mT, side.unsqueeze(-1)], -1))
        reduced = shape - (cross @ solved[..., :-1]).sum(0)
        reduced_side = shape_side - (cross @ solved[..., -1:]).sum(0).squeeze(-1)
        betas = torch.linalg.solve(reduced, reduced_side)
        return solved[..., -1] - solved[..., :-1] @ betas, betas

    def _limit_terms(self, rows: list[int]) -> tuple[Tensor, Tensor]:
        """Quadratic walls beyond the joint limits."""
        index = torch.tensor(rows)
        angles = torch.einsum(
            "jab,rjb->rja", self._axes, self.table.values["hand_pose"][index].double().unflatten(1, (15, 3))
        )
        low, high = self._limits[..., 0] - angles, angles - self._limits[..., 1]
        beyond = torch.where(low > 0, low, torch.where(high > 0, -high, torch.zeros_like(low)))
        strength = (beyond != 0).double() / self.priors.limit**2
        matrix = torch.zeros(len(rows), POSE_SIZE, POSE_SIZE, dtype=torch.float64)
        side = torch.zeros(len(rows), POSE_SIZE, dtype=torch.float64)
        blocks = self._axes.mT @ (strength.unsqueeze(-1) * self._axes)
        for joint in range(15):
            at = slice(3 + 3 * joint, 6 + 3 * joint)
            matrix[:, at, at] = blocks[:, joint]
        side[:, 3:48] = ((strength * beyond).unsqueeze(-2) @ self._axes).squeeze(-2).flatten(1)
        return matrix, side

    def _landmark_terms(self, rows: list[int], sigma: float) -> tuple[Tensor, Tensor]:
        """The tracker's points, robustly: they say which finger is where when outlines cannot."""
        p = self.priors
        index = torch.tensor(rows)
        # Every row as it stands and moved by each of its numbers, all of them at once.
        steps = torch.cat([torch.zeros(1, POSE_SIZE), DIFFERENCE * torch.eye(POSE_SIZE)])
        each = torch.arange(len(rows)).repeat(len(steps))
        with torch.no_grad():
            moved = turned(self.poses(rows).rows(each), steps.repeat_interleave(len(rows), 0))
            joints, turns = self.shape.model.skeleton(moved)
            marks = tracked_points(joints, turns, self.shape.model.side, self._at_joints[index][each])
            here, *there = self.camera.project(marks).unflatten(0, (len(steps), len(rows)))
        columns = [(place - here) / DIFFERENCE for place in there]
        jacobian = (torch.stack(columns, -1) / self._sizes[index].view(-1, 1, 1, 1)).double()
        apart = ((self._points[index] - here) / self._sizes[index].view(-1, 1, 1)).double()
        length = apart.norm(dim=-1).clamp_min(1e-9)
        scores = torch.tensor([self.views[row].score for row in rows], dtype=torch.float64)
        weight = (
            scores[:, None] * torch.where(length < p.landmark_knee, 1.0, p.landmark_knee / length) / sigma**2
        )
        weighted = jacobian * weight[..., None, None]
        flat = jacobian.flatten(1, 2)
        return flat.mT @ weighted.flatten(1, 2), (
            weighted.flatten(1, 2).mT @ apart.flatten(1, 2).unsqueeze(-1)
        ).squeeze(-1)

    def _move(self, rows: list[int], steps: Tensor) -> None:
        limited = steps.float()
        limited[:, :48] = limited[:, :48].clamp(-0.3, 0.3)
        limited[:, 48:] = limited[:, 48:].clamp(-0.03, 0.03)
        good = torch.isfinite(limited).all(-1)
        index = torch.tensor(rows)[good]
        self.table.put(index, turned(self.poses(index.tolist()), limited[good]))

    def _move_surface(self, subdivision: Subdivision, blocks: Tensor, sides: Tensor) -> None:
        """The rest surface's offsets [V,3]: all frames' evidence against smoothness."""
        p = self.priors
        k = p.trust
        edges = self._edges

        def smooth(d: Tensor) -> Tensor:
            between = (d[edges[:, 0]] - d[edges[:, 1]]) / p.offset_bend**2
            total = d / p.offset**2
            return total.index_add(0, edges[:, 0], between).index_add(0, edges[:, 1], -between)

        def apply(d: Tensor) -> Tensor:
            return k * subdivision.gather((blocks @ subdivision.apply(d).unsqueeze(-1)).squeeze(-1)) + smooth(
                d
            )

        right = k * subdivision.gather(sides) - smooth(self.shape.displacement)
        step = conjugate_gradients(apply, right, 60)
        self.shape.displacement += step.clamp(-0.003, 0.003)


def conjugate_gradients(apply: Callable[[Tensor], Tensor], right: Tensor, iterations: int) -> Tensor:
    """x with apply(x) = right for a symmetric positive operator, from zero."""
    x, residual = torch.zeros_like(right), right.clone()
    direction, power = residual, float(residual.square().sum())
    first = power
    for _ in range(iterations):
        if power <= 1e-12 * first or power == 0.0:
            break
        moved = apply(direction)
        along = power / float((direction * moved).sum())
        x = x + along * direction
        residual = residual - along * moved
        new = float(residual.square().sum())
        direction, power = residual + (new / power) * direction, new
    return x


def _pull(evidence: Evidence2D) -> float:
    weight = evidence.hessian[:, 0] + evidence.hessian[:, 2]
    used = weight > 0
    if not bool(used.any()):
        return 0.0
    return float((evidence.gradient[used].norm(dim=-1) / weight[used]).mean())
