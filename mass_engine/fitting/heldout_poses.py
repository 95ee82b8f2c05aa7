"""Poses of held-out frames: from their neighbours, landmarks and silhouettes, never from their colours."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from mass_engine.fitting.evidence import spread
from mass_engine.fitting.gauss_newton import Registrar, Round
from mass_engine.fitting.kinematics import turned
from mass_engine.fitting.starts import Measure, best_of, difference
from mass_engine.fitting.subject import Appearance
from mass_engine.hand.pose import HandPose
from mass_engine.surfel.binding import MeshBinding
from mass_engine.tracking.alignment import interpolate_pose

#: So far below the training frames' usual overlap, another start is tried.
BELOW = 0.03
#: What an outline may lose against the neighbours' interpolated pose: the surface stands over it on purpose.
SLACK = 0.025
#: What a later start must overlap more to be taken for an earlier one.
MARGIN = 0.01
#: Training frames that say what is usual.
USUAL = 40


def place_heldout(
    fit: Registrar, stages: Sequence[Round], binding: MeshBinding, start: HandPose, measure: Measure
) -> None:
    """Register the held-out rows of ``fit`` to their outlines by ``stages``.

    They begin between their refined neighbours. Where an outline says little (a sleeve hides the wrist) steps
    may lead away: then a row goes on from its pose in ``start`` [F], corrected as its nearest neighbour's
    was, then from that neighbour's pose, then from that of the other side; or the best outline wins.
    ``measure`` says how well the finished hand overlaps.
    """
    views, trained = fit.views, fit.trained
    heldout = [row for row, view in enumerate(views) if view.heldout]
    look = Appearance.plain(binding.count, fit.light)
    usual = float(measure(spread(trained, USUAL)).median())
    times = [views[row].time for row in heldout]
    between = interpolate_pose(fit.poses(trained), [views[row].time for row in trained], times)
    sides = [_neighbours(row, trained, fit) for row in heldout]
    near, far = [pair[0] for pair in sides], [pair[1] for pair in sides]
    correction = difference(start.rows(torch.tensor(near)), fit.poses(near))
    corrected = turned(start.rows(torch.tensor(heldout)), correction)
    starts = (between, corrected, fit.poses(near), fit.poses(far))
    best_of(fit, heldout, between, starts, stages, binding, look, measure, SLACK, usual - BELOW, MARGIN)


def _neighbours(row: int, trained: list[int], fit: Registrar) -> tuple[int, int]:
    """The nearest training row in time, and the nearest on its other side (or itself, at an end)."""
    sides = [other for other in trained if other < row][-1:] + [other for other in trained if other > row][:1]
    apart = [abs(fit.views[other].time - fit.views[row].time) for other in sides]
    ordered = [other for _, other in sorted(zip(apart, sides, strict=True))]
    return ordered[0], ordered[-1]
