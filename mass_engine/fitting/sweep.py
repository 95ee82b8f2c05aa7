"""The sweep over the frames that makes the first sharp texture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from mass_engine.fitting.gauss_newton import Registrar, Round
from mass_engine.fitting.kinematics import turned
from mass_engine.fitting.starts import Measure, best_of, difference
from mass_engine.fitting.subject import Appearance
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
    measure: Measure,
    progress: Callable[[float], None] | None = None,
    memory: float = 0.95,
) -> None:
    """Register frame after frame, outward from the one that shows most, against the texture so far.

    A texture averaged over badly registered frames is flat and pulls nowhere; one that grows from a
    single frame is sharp from the start. A frame begins with its neighbour's correction; where that leads
    off its silhouette (``measure``) it begins with its own pose, or keeps that: one frame gone wrong would
    drag along all that follow.
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
            starts = (turned(before, near), before)
            best_of(fit, [row], before, starts, stages, binding, look, measure, SLACK, motion=False)
        moved[place] = difference(before, fit.poses([row]))
        total = total * memory + gather(row)
        if progress is not None:
            progress((done + 1) / len(trained))
