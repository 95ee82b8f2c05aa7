"""The beginning of stage one: poses, shape and personal surface by gradient descent, from afar.

Slow but far-sighted: outline and landmarks pull from any distance. ``gauss_newton`` takes over from here.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from mass_engine.camera import Camera
from mass_engine.fitting import losses
from mass_engine.fitting.exposure import without
from mass_engine.fitting.guard import Guard
from mass_engine.fitting.poses import PoseTable
from mass_engine.fitting.subject import (
    Appearance,
    PosedSurfels,
    Shape,
    mesh_edges,
    pose_surfels,
    render_row,
)
from mass_engine.fitting.views import View
from mass_engine.hand.builtin import joint_frames, joint_limits
from mass_engine.raster import RasterOptions
from mass_engine.surfel.binding import MeshBinding
from mass_engine.tracking.alignment import hand_size_pixels, limit_excess
from mass_engine.tracking.offsets import tracked_points


@dataclass(frozen=True)
class GeometryWeights:
    """What each term weighs in stage one."""

    color: float = 1.0
    silhouette: float = 1.0
    outline: float = 2.0  # per hand size
    landmarks: float = 0.5
    limits: float = 0.5
    smooth: float = 2.0
    shape: float = 1e-3
    laplacian: float = 4e3  # per metre^2 across an edge
    thickness: float = 2e2  # per metre^2 of displacement


@dataclass(frozen=True)
class GeometryPass:
    """One resolution of stage one: how large, how often each frame is seen, and what may move."""

    side: int
    visits: float
    levels: int = 0
    depth: int = 1
    rate: float = 1.0
    batch: int = 4
    color: bool = True
    weights: GeometryWeights = field(default_factory=GeometryWeights)


#: Learning rates of what all frames share: standard deviations, metres, colour, light.
SHARED_RATES = {"betas": 0.02, "displacement": 1.5e-4, "albedo": 0.02, "light": 0.005}


class GeometryFit:
    """Stage one over ``views`` (rows of ``table``)."""

    def __init__(
        self,
        views: list[View],
        table: PoseTable,
        shape: Shape,
        camera: Camera,
        seed: int,
        raster: RasterOptions,
    ) -> None:
        self.views, self.table, self.shape = views, table, shape
        self.camera, self.raster = camera, raster
        #: How much brighter each frame's colours are [F,3].
        self.gains = torch.ones(len(views), 3)
        self.undone = 0
        self._seed = seed
        self._edges = mesh_edges(shape.model.faces)
        self._limits, self._frames = joint_limits(), joint_frames(shape.model)
        self._points = torch.stack([torch.from_numpy(view.points) for view in views])
        self._sizes = hand_size_pixels(self._points)
        self._scores = torch.tensor([view.score for view in views])
        self._at_joints = torch.tensor([view.at_joints for view in views])
        self._times = torch.tensor([view.time for view in views], dtype=torch.float64)
        trained = [row for row, view in enumerate(views) if not view.heldout]
        self._trained = torch.tensor(trained)
        self._before, self._after, self._mix, self._near = _neighbours(views, trained)

    def run(
        self,
        stage: GeometryPass,
        binding: MeshBinding,
        appearance: Appearance,
        progress: Callable[[float], None] | None = None,
    ) -> None:
        """Run one pass over the training rows with the surfels of ``binding``."""
        # Everything a pass remembers begins with it: a fit resumed between two passes goes on alike.
        random = torch.Generator().manual_seed(self._seed * 1009 + stage.side)
        with torch.no_grad():
            self._joints = self.shape.model.joints(self.table.pose(self.shape.betas))
        rows = self._trained
        steps = max(1, round(stage.visits * len(rows) / stage.batch))
        shared = self._shared_parameters(appearance)
        optimizer = torch.optim.Adam(
            [{"params": [value], "lr": SHARED_RATES[name] * stage.rate} for name, value in shared.items()],
            betas=(0.9, 0.98),
            eps=1e-15,
        )
        self.table.reset_momentum()
        guard = Guard([*shared.values(), *self.table.values.values()])
        queue = torch.zeros(0, dtype=torch.long)
        for step in range(steps):
            if len(queue) < stage.batch:
                queue = torch.cat([queue, rows[torch.randperm(len(rows), generator=random)]])
            chosen, queue = queue[: stage.batch].unique(), queue[stage.batch :]
            decay = guard.rate * 0.1 ** (step / steps)
            for group, name in zip(optimizer.param_groups, shared, strict=True):
                group["lr"] = SHARED_RATES[name] * stage.rate * decay
            leaves = self.table.leaves(chosen)
            optimizer.zero_grad(set_to_none=True)
            loss = self._loss(stage, binding, appearance, chosen, leaves, random)
            loss.backward()
            if guard.good(loss, [leaf.grad for leaf in leaves.values()]):
                self.table.step(chosen, leaves, stage.rate * decay)
                optimizer.step()
            if progress is not None:
                progress((step + 1) / steps)
        self.undone += guard.undone
        for value in shared.values():
            value.requires_grad_(False)
            value.grad = None

    def _shared_parameters(self, appearance: Appearance) -> dict[str, Tensor]:
        parameters = {
            "betas": self.shape.betas,
            "displacement": self.shape.displacement,
            "albedo": appearance.albedo,
            "light": appearance.light,
        }
        return {name: value.requires_grad_(True) for name, value in parameters.items()}

    def _loss(
        self,
        stage: GeometryPass,
        binding: MeshBinding,
        appearance: Appearance,
        rows: Tensor,
        leaves: dict[str, Tensor],
        random: torch.Generator,
    ) -> Tensor:
        w = stage.weights
        surfels = pose_surfels(self.shape, binding, self.table.pose(self.shape.betas, leaves))
        camera = self.camera.world_to_camera
        in_camera = surfels.outline_vertices @ camera[:3, :3].T + camera[:3, 3]
        total = torch.zeros(())
        for place, row in enumerate(rows.tolist()):
            level = without(self.views[row].level(stage.side), self.gains[row])
            background = torch.rand(3, generator=random)
            out = render_row(
                appearance,
                surfels,
                place,
                binding.bones,
                level.camera,
                self.raster,
                background if stage.color else None,
            )
            area = level.hand.sum().clamp_min(16.0)
            K, outline = self.views[row].camera.K, self.views[row].outline()
            flat = in_camera[place, :, :2] / in_camera[place, :, 2:].clamp_min(1e-3) @ K[:2, :2].T + K[:2, 2]
            apart = losses.outline_distance(flat, outline.points, outline.outside)
            total = total + w.outline * apart / (self._sizes[row] * K[0, 0] / self.camera.K[0, 0])
            total = total + w.silhouette * losses.silhouette(out.alpha, level.hand, level.valid, area)
            if stage.color:
                cover = level.hand.unsqueeze(-1)
                target = level.rgb * cover + background * (1 - cover)
                total = total + w.color * losses.photometric(out.rgb, target, level.colored, area)
        total = total + self._pose_terms(w, rows, leaves, surfels) * len(rows)
        total = total / len(rows)
        d = self.shape.displacement
        total = total + w.shape * self.shape.betas.square().sum()
        total = total + w.laplacian * losses.laplacian(d, self._edges)
        return total + w.thickness * d.square().mean()

    def _pose_terms(
        self, w: GeometryWeights, rows: Tensor, leaves: dict[str, Tensor], surfels: PosedSurfels
    ) -> Tensor:
        """Landmarks, joint limits and smoothness in time, averaged over the batch."""
        joints, side = surfels.joints, self.shape.model.side
        marks = tracked_points(joints, surfels.bone_rotations, side, self._at_joints[rows])
        pixels = (self.camera.project(marks) - self._points[rows]).norm(dim=-1)
        apart = losses.charbonnier(pixels / self._sizes[rows, None], 0.03).mean(-1) * self._scores[rows]
        excess = limit_excess(leaves["hand_pose"], self._limits, self._frames).square().sum((-1, -2))
        mix = self._mix[rows].view(-1, 1, 1)
        between = self._joints[self._before[rows]] * (1 - mix) + self._joints[self._after[rows]] * mix
        jerk = losses.charbonnier((joints - between).norm(dim=-1) / 0.18, 0.03).mean(-1)
        self._joints[rows] = joints.detach()
        return (w.landmarks * apart + w.limits * excess + w.smooth * self._near[rows] * jerk).mean()


def _neighbours(views: list[View], trained: list[int]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """For every row: the training rows before and after, its place between them, and how near they are."""
    before, after = torch.arange(len(views)), torch.arange(len(views))
    mix, near = torch.full((len(views),), 0.5), torch.zeros(len(views))
    for row, view in enumerate(views):
        earlier, later = bisect_left(trained, row) - 1, bisect_right(trained, row)
        if earlier < 0 or later >= len(trained):
            continue
        before[row], after[row] = trained[earlier], trained[later]
        low, high = views[trained[earlier]].time, views[trained[later]].time
        mix[row] = (view.time - low) / (high - low)
        # Two frames apart at 30 a second is near; the pull falls with the square of the span.
        near[row] = min(1.0, ((high - low) * 15) ** -2)
    return before, after, mix, near
