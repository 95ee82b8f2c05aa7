"""The baselines learn a small clip; 3-D Gaussians are projected as 3DGS projects them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from mass_engine.avatar import SourceFrames
from mass_engine.camera import Camera
from mass_engine.evaluation.baselines import (
    BASELINES,
    BaselineName,
    Registered,
    fit_baseline,
    frames_per_second,
)
from mass_engine.evaluation.scores import score_view
from mass_engine.evaluation.splats import projected_tangents, steps_of
from mass_engine.fitting.subject import Shape
from mass_engine.hand.builtin import load_builtin
from mass_engine.hand.pose import HandPose
from mass_engine.raster import RasterOptions, rasterize
from mass_engine.surfel.inellipse import quat_to_matrix
from mass_engine.surfel.shading import white_light
from tests.engine.fitting.clips import CAMERA, make_views, true_poses


@pytest.fixture(scope="module")
def hand() -> Registered:
    poses = true_poses(5)
    views = make_views(poses, heldout=frozenset({2}))
    frames = SourceFrames(
        torch.arange(5), torch.tensor([view.heldout for view in views]), poses, torch.ones(len(views), 3)
    )
    shape = Shape.mean(load_builtin("right"), torch.zeros(10))
    return Registered(views, shape, white_light(), CAMERA, frames, 0.0)


def test_a_baseline_learns_from_frames_without_their_gains(hand: Registered) -> None:
    gains = torch.linspace(0.6, 1.0, 5).unsqueeze(-1).expand(5, 3)
    dark = [
        replace(view, rgb=(view.rgb * gains[row].numpy()).round().astype(np.uint8), _levels={})
        for row, view in enumerate(hand.views)
    ]
    known = replace(hand, views=dark, frames=replace(hand.frames, gains=gains))
    for name in ("mesh", "surfels-vertices"):
        one, two, spoilt = (
            fit_baseline(name, given, 0, effort=0.03).render_pose(hand.pose(2), CAMERA).rgb
            for given in (hand, known, replace(known, frames=hand.frames))
        )
        assert float((one - two).abs().mean()) < 0.2 * float((one - spoilt).abs().mean()), name


@pytest.mark.parametrize("name", BASELINES)
def test_a_baseline_learns_the_look_and_shows_it_in_a_frame_it_has_not_seen(
    hand: Registered, name: BaselineName
) -> None:
    made = fit_baseline(name, hand, 0, effort=0.3)
    found = score_view(made, hand.views[2], hand.pose(2))
    assert found["psnr_in_mask"] > 18, found
    assert found["silhouette_iou"] > 0.9, found
    assert 10_000 < made.size_bytes < 10_000_000
    assert frames_per_second(made, hand.pose(2), hand.views[2].camera, 0.01) > 0
    again = fit_baseline(name, hand, 0, effort=0.01)
    twice = fit_baseline(name, hand, 0, effort=0.01)
    one, two = (m.render_pose(hand.pose(0), CAMERA.resized(40, 30)).rgb for m in (again, twice))
    torch.testing.assert_close(one, two)


def test_effort_is_how_much_a_baseline_sees(hand: Registered) -> None:
    assert steps_of(5.0, 100, 1.0) == 500
    assert steps_of(5.0, 100, 0.3) == 150
    assert steps_of(1.0, 4, 0.3) == steps_of(1.0, 120, 0.3) == 36  # few frames are seen more often
    assert steps_of(1.0, 4, 1e-6) == 1
    seen: list[int] = []

    class Watched(Registered):
        def pose(self, row: int) -> HandPose:
            seen.append(row)
            return super().pose(row)

    def counts(effort: float) -> dict[int, int]:
        seen.clear()
        fit_baseline("mesh", Watched(**vars(hand)), 0, effort)
        return {row: seen.count(row) for row in hand.trained}

    whole, part = counts(1.0), counts(2 / 120)
    assert [row for row in whole if whole[row] > part[row]] == [1, 3]  # the first and the last are left


def test_a_disc_of_a_gaussian_has_its_projected_covariance() -> None:
    camera = Camera.from_fov(64, 48, 50.0)
    turn = torch.eye(4)
    turn[:3, :3] = quat_to_matrix(torch.nn.functional.normalize(torch.tensor([0.9, 0.1, -0.3, 0.2]), dim=0))
    camera = Camera(camera.K, turn, 64, 48)
    inside = torch.tensor([[0.02, -0.03, 0.5]])
    means = (inside - turn[:3, 3]) @ turn[:3, :3]
    random = torch.Generator().manual_seed(0)
    axes = 0.02 * torch.randn(1, 3, 3, generator=random)
    tangents = projected_tangents(means, axes, camera)
    out = rasterize(means, tangents, torch.tensor([0.9]), torch.ones(1, 3), camera, options=RasterOptions())
    # The covariance in pixels, by samples of the Gaussian projected one by one (small: nearly affine).
    samples = means + (torch.randn(20000, 3, generator=random) @ axes[0].T) * 0.05
    pixels = camera.project(samples)
    covariance = torch.cov(pixels.T) / 0.05**2 + 0.3 * torch.eye(2)
    rows, columns = torch.meshgrid(torch.arange(48) + 0.5, torch.arange(64) + 0.5, indexing="ij")
    apart = torch.stack([columns, rows], -1) - camera.project(means)[0]
    power = (apart @ torch.linalg.inv(covariance) * apart).sum(-1)
    expected = 0.9 * torch.exp(-0.5 * power)
    strong = expected > 0.05
    assert int(strong.sum()) > 50
    torch.testing.assert_close(out.alpha[strong], expected[strong], atol=0.02, rtol=0.05)
