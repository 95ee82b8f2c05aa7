"""Of several starts, the one that keeps the silhouette; held-out frames are not led off theirs."""

from __future__ import annotations

from dataclasses import replace

import torch

from mass_engine.fitting.evidence import Scene
from mass_engine.fitting.gauss_newton import Registrar, Round
from mass_engine.fitting.heldout_poses import place_heldout
from mass_engine.fitting.kinematics import turned
from mass_engine.fitting.poses import PoseTable
from mass_engine.fitting.skin import Skin
from mass_engine.fitting.starts import Measure, best_of, difference
from mass_engine.fitting.subject import Appearance, Shape
from mass_engine.hand.builtin import load_builtin
from mass_engine.hand.pose import HandPose
from mass_engine.raster import RasterOptions
from mass_engine.surfel.binding import MeshBinding
from mass_engine.tracking.alignment import interpolate_pose
from tests.engine.fitting.clips import CAMERA, make_views, painted, true_poses


def _measure(fit: Registrar, binding: MeshBinding, look: Appearance) -> Measure:
    scene = Scene(fit.views, fit.table, fit.shape, fit.raster, torch.ones(len(fit.views), 3))
    skin = Skin.attached(binding)
    return lambda rows: scene.overlaps(skin, look, rows)


def test_a_frame_led_astray_keeps_its_own_pose() -> None:
    model = load_builtin("right")
    truth = true_poses(3)
    shape = Shape.mean(model, torch.zeros(10))
    fit = Registrar(make_views(truth), PoseTable(truth), shape, CAMERA, RasterOptions(cull_backfaces=True))
    binding = MeshBinding.build(model, 1, 1)
    look = painted(binding)
    measure = _measure(fit, binding, look)
    before, own = measure([1]), fit.poses([1])
    wrong = torch.zeros(1, 51)
    wrong[:, 48] = 0.05  # 5 cm aside: no evidence reaches so far
    stages = (Round(96, betas=False, offsets=False),)
    best_of(fit, [1], own, [turned(own, wrong), own], stages, binding, look, measure, 0.005, motion=False)
    assert float(measure([1])) > float(before) - 0.01
    assert float(difference(own, fit.poses([1]))[:, 48:].norm()) < 0.01


def test_a_good_correction_is_taken() -> None:
    model = load_builtin("right")
    truth = true_poses(3)
    aside = torch.zeros(3, 51)
    aside[:, 48] = 0.004
    shape = Shape.mean(model, torch.zeros(10))
    start = turned(truth, aside)
    fit = Registrar(make_views(truth), PoseTable(start), shape, CAMERA, RasterOptions(cull_backfaces=True))
    binding = MeshBinding.build(model, 1, 1)
    look = painted(binding)
    measure = _measure(fit, binding, look)
    own = fit.poses([1])
    stages = (Round(160, betas=False, offsets=False),)
    best_of(
        fit, [1], own, [turned(own, -aside[:1]), own], stages, binding, look, measure, 0.005, motion=False
    )
    apart = difference(fit.poses([1]), turned(own, -aside[:1]))
    assert float(apart[:, 48:50].norm()) < 0.001


def test_a_heldout_frame_whose_steps_lose_its_outline_stays_between_its_neighbours() -> None:
    model = load_builtin("right")
    truth = true_poses(5)
    aside = torch.zeros(5, 51)
    aside[2, 48] = 0.004
    views = make_views(truth)
    views[2] = replace(views[2], heldout=True)
    start = turned(truth, aside)
    stages = (Round(160, texture=False, betas=False, offsets=False),)

    def placed(loss: float) -> HandPose:
        """Where row 2 ends if every step from between its neighbours costs so much of its outline."""
        table = PoseTable(start)
        fit = Registrar(
            views, table, Shape.mean(model, torch.zeros(10)), CAMERA, RasterOptions(cull_backfaces=True)
        )
        seen: list[HandPose] = []

        def measure(rows: list[int]) -> torch.Tensor:
            if rows != [2]:
                return torch.ones(len(rows))
            seen.append(fit.poses(rows))
            return torch.tensor([1.0 - loss * (len(seen) > 1)])

        place_heldout(fit, stages, MeshBinding.build(model, 1, 0), start, measure)
        assert len(seen) == (2 if loss == 0 else 5)  # the first of four starts is enough, or none is
        return fit.poses([2])

    apart = difference(placed(0.5), placed(0.0))
    between = difference(placed(0.5), interpolate_pose(truth.rows(torch.tensor([1, 3])), [0.0, 1.0], [0.5]))
    assert float(between.abs().max()) < 1e-5
    assert float(apart.abs().max()) > 1e-4
