"""The sweep over the frames that makes the first sharp texture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from mass_engine.fitting.gauss_newton import Registrar, Round
from mass_engine.fitting.kinematics import turned
from mass_engine.fitting.registration import overlap
from mass_engine.fitting.subject import Appearance, pose_surfels, render_row
from mass_engine.hand.pose import HandPose
from mass_engine.hand.rotation import axis_angle_to_matrix, matrix_to_axis_angle
from mass_engine.surfel.binding import MeshBinding
from mass_engine.surfel.shading import white_light

#: What one frame (row) says of every surfel's colour: its sum under the blending weights, and these [N,4].
Gather = Callable[[int], Tensor]
#: What a frame's silhouette may lose in the sweep: texture pulls, too, and sees what outlines do not.
SLACK = 0.005


def sweep(
    fit: Registrar,
    stages: Sequence[Round],
    binding: MeshBinding,
    gather: Gather,
    progress: Callable[[float], None] | None = None,
    memory: float = 0.95,
) -> None:
    """Register frame after frame, outward from the one that shows most, against the texture so far.

    A texture averaged over badly registered frames is flat and pulls nowhere; one that grows from a
    single frame is sharp from the start. A frame begins with its neighbour's correction; where that leads
    off its silhouette it begins with its own pose, or keeps that: one frame gone wrong would drag along
    all that follow.
    """
    trained = fit.trained
    key = max(range(len(trained)), key=lambda place: float((fit.views[trained[place]].labels == 255).sum()))
    total = torch.zeros(binding.count, 4)
    moved: dict[int, Tensor] = {}
    for done, place in enumerate(sorted(range(len(trained)), key=lambda place: abs(place - key))):
        row = trained[place]
        before = fit.poses([row])
        if place != key:
            near = moved[place - 1 if place > key else place + 1]
            known = total[:, 3:] > 0.05
            mean = total[:, :3].sum(0) / total[:, 3].sum()
            albedo = torch.where(known, total[:, :3] / total[:, 3:].clamp_min(1e-6), mean)
            look = replace(Appearance.plain(binding.count, white_light()), albedo=albedo)
            _best_of(fit, row, [turned(before, near), before], stages, binding, look)
        moved[place] = difference(before, fit.poses([row]))
        total = total * memory + gather(row)
        if progress is not None:
            progress((done + 1) / len(trained))


def _best_of(
    fit: Registrar,
    row: int,
    starts: list[HandPose],
    stages: Sequence[Round],
    binding: MeshBinding,
    look: Appearance,
) -> None:
    """Take the first of ``starts`` whose steps keep the silhouette of the last, or the best of all."""
    index = torch.tensor([row])
    fit.table.put(index, starts[-1])
    tried = [(_silhouette(fit, row, binding, look), starts[-1])]
    least = tried[0][0] - SLACK
    for start in starts:
        fit.table.put(index, start)
        fit.forget([row])
        for stage in stages:
            fit.step(stage, binding, look, [row], motion=False)
        covered = _silhouette(fit, row, binding, look)
        if covered >= least:
            return
        tried.append((covered, fit.poses([row])))
    fit.table.put(index, max(tried, key=lambda pair: pair[0])[1])
    fit.forget([row])


def _silhouette(fit: Registrar, row: int, binding: MeshBinding, look: Appearance) -> float:
    """How well the silhouettes of a row overlap as it stands."""
    level = fit.views[row].level(160)
    with torch.no_grad():
        surfels = pose_surfels(fit.shape, binding, fit.poses([row]))
        out = render_row(look, surfels, 0, binding.bones, level.camera, fit.raster)
    return overlap(level, out.alpha)


def difference(before: HandPose, after: HandPose) -> Tensor:
    """The step [B,51] that :func:`turned` takes from ``before`` to ``after``."""
    columns = []
    for name in ("global_orient", "hand_pose"):
        goal = axis_angle_to_matrix(getattr(after, name).unflatten(-1, (-1, 3)))
        here = axis_angle_to_matrix(getattr(before, name).unflatten(-1, (-1, 3)))
        columns.append(matrix_to_axis_angle(goal @ here.mT).flatten(1))
    return torch.cat([*columns, after.transl - before.transl], -1)
