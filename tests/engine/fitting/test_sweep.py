"""The sweep: a neighbour's wrong correction does not drag a frame along."""

from __future__ import annotations

import torch

from mass_engine.fitting.gauss_newton import Registrar, Round
from mass_engine.fitting.kinematics import turned
from mass_engine.fitting.poses import PoseTable
from mass_engine.fitting.subject import Shape
from mass_engine.fitting.sweep import _best_of, _silhouette, difference
from mass_engine.hand.builtin import load_builtin
from mass_engine.raster import RasterOptions
from mass_engine.surfel.binding import MeshBinding
from tests.engine.fitting.clips import CAMERA, make_views, painted, true_poses


def test_a_frame_led_astray_keeps_its_own_pose() -> None:
    model = load_builtin("right")
    truth = true_poses(3)
    shape = Shape.mean(model, torch.zeros(10))
    fit = Registrar(make_views(truth), PoseTable(truth), shape, CAMERA, RasterOptions(cull_backfaces=True))
    binding = MeshBinding.build(model, 1, 1)
    look = painted(binding)
    before, own = _silhouette(fit, 1, binding, look), fit.poses([1])
    wrong = torch.zeros(1, 51)
    wrong[:, 48] = 0.05  # 5 cm aside: no evidence reaches so far
    _best_of(fit, 1, [turned(own, wrong), own], (Round(96, betas=False, offsets=False),), binding, look)
    assert _silhouette(fit, 1, binding, look) > before - 0.01
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
    own = fit.poses([1])
    _best_of(fit, 1, [turned(own, -aside[:1]), own], (Round(160, betas=False, offsets=False),), binding, look)
    apart = difference(fit.poses([1]), turned(own, -aside[:1]))
    assert float(apart[:, 48:50].norm()) < 0.001
