"""Several places that a pose may begin from: the one whose steps lead best is taken."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from mass_engine.fitting.gauss_newton import Registrar, Round
from mass_engine.fitting.subject import Appearance
from mass_engine.hand.pose import HandPose
from mass_engine.hand.rotation import axis_angle_to_matrix, matrix_to_axis_angle
from mass_engine.surfel.binding import MeshBinding

#: How well the silhouettes of rows overlap as they stand [B].
Measure = Callable[[list[int]], Tensor]


def best_of(
    fit: Registrar,
    rows: list[int],
    kept: HandPose,
    starts: Sequence[HandPose],
    stages: Sequence[Round],
    binding: MeshBinding,
    look: Appearance,
    measure: Measure,
    slack: float,
    floor: float = 0.0,
    margin: float = 0.0,
    motion: bool = True,
) -> None:
    """Give every row [B] the first of ``starts`` (each [B]) whose steps lose at most ``slack`` of the
    silhouette of ``kept`` [B] and overlap by ``floor`` at least.

    Where none does, an earlier one goes before a later one that overlaps by less than ``margin`` more, and
    ``kept`` before all that lose too much. ``measure`` says how well the silhouettes of rows overlap as they
    stand.
    """
    fit.table.put(torch.tensor(rows), kept)
    best, found = measure(rows) - slack - margin, fit.poses(rows)
    open_ = torch.arange(len(rows))
    for start in starts:
        part = [rows[place] for place in open_.tolist()]
        fit.table.put(torch.tensor(part), start.rows(open_))
        fit.forget(part)
        for stage in stages:
            fit.step(stage, binding, look, part, motion=motion)
        covered, reached = measure(part), fit.poses(part)
        better = covered >= best[open_] + margin
        best[open_[better]] = covered[better]
        for name in ("global_orient", "hand_pose", "transl"):
            getattr(found, name)[open_[better]] = getattr(reached, name)[better]
        open_ = open_[~better | (covered < floor)]
        if not len(open_):
            return
    last = [rows[place] for place in open_.tolist()]
    fit.table.put(torch.tensor(last), found.rows(open_))
    fit.forget(last)


def difference(before: HandPose, after: HandPose) -> Tensor:
    """The step [B,51] that ``kinematics.turned`` takes from ``before`` to ``after``."""
    columns = []
    for name in ("global_orient", "hand_pose"):
        goal = axis_angle_to_matrix(getattr(after, name).unflatten(-1, (-1, 3)))
        here = axis_angle_to_matrix(getattr(before, name).unflatten(-1, (-1, 3)))
        columns.append(matrix_to_axis_angle(goal @ here.mT).flatten(1))
    return torch.cat([*columns, after.transl - before.transl], -1)
