"""The rendered clips: is the truth exact, is the hand another one, does the benchmark run."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from mass_engine.cli import main
from mass_engine.evaluation.heldout import REFINED
from mass_engine.evaluation.synthetic.benchmark import CASES, GEOMETRY, scene_of
from mass_engine.evaluation.synthetic.hand import HAND, IGNORED, OtherHand
from mass_engine.evaluation.synthetic.scene import Scene, TrueFrame
from mass_engine.hand.builtin import load_builtin
from mass_engine.surfel.subdivision import loop_subdivision


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scene_of("all", 0, quick=True)


@pytest.fixture(scope="module")
def frame(scene: Scene) -> TrueFrame:
    frames = scene.frames()
    next(frames)
    return next(frames)


def test_depth_normals_and_masks_are_of_the_same_surface(scene: Scene, frame: TrueFrame) -> None:
    hit = frame.depth > 0
    assert hit.sum() > 2000
    rows, columns = np.nonzero(hit)
    rays = (
        np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], 1)
        @ np.linalg.inv(scene.camera.K.double().numpy()).T
    )
    points = rays * frame.depth[hit][:, None]
    # Every point lies on the mesh: within a triangle of a vertex, and the normal looks at the camera.
    apart = torch.cdist(torch.from_numpy(points[::29]), torch.from_numpy(frame.vertices)).amin(1)
    assert float(apart.max()) < 0.0015
    assert ((frame.normals[hit] * points).sum(1) < 0).mean() > 0.99
    # Blur and anti-aliasing move the mask's edge by a pixel or two, no more.
    inside = frame.labels == HAND
    assert (inside & hit).sum() / (inside | (hit & (frame.labels != IGNORED))).sum() > 0.95
    assert (frame.labels == IGNORED).sum() > 300
    assert (frame.coverage[frame.labels == IGNORED] == 0).all()
    assert (frame.coverage[frame.labels == HAND] > 0.5).all()
    pixels = scene.camera.project(torch.from_numpy(frame.points).float())
    assert bool(((pixels > 0) & (pixels < torch.tensor([320, 240]))).all())


def test_the_hand_is_not_the_fitted_model() -> None:
    hand = OtherHand.make()
    base = load_builtin("right")
    wanted = hand.model.template - base.template
    basis = base.shape_basis.flatten(0, 1)
    best = torch.linalg.lstsq(basis, wanted.flatten()[:, None]).solution
    left = (wanted.flatten() - (basis @ best)[:, 0]).view(-1, 3).norm(dim=-1)
    assert float(left.mean()) > 0.001  # no shape parameters, however large, give it
    assert float(left.max()) > 0.003
    assert float((hand.model.weights - base.weights).abs().max()) > 0.05
    fine = loop_subdivision(base.faces, len(base.template), 3)
    assert fine.n_vertices == len(hand.relief) == len(hand.albedo)
    assert 0.0001 < float(hand.relief.abs().max()) < 0.001
    smooth = OtherHand.make(wrinkles=False)
    assert float(smooth.relief.abs().max()) == 0


def test_cases_show_what_they_say() -> None:
    assert {"plain", "all"} <= CASES.keys()
    still, moving = (scene_of(name, 0, quick=True) for name in ("plain", "moving-light"))
    np.testing.assert_array_equal(still._light(0.1), still._light(0.6))
    assert np.abs(moving._light(0.1) - moving._light(0.6)).max() > 0.1
    plain = next(still.frames())
    assert (plain.labels == IGNORED).sum() == 0


def test_the_benchmark_runs(tmp_path: Path) -> None:
    assert main(["eval", "synthetic", "--quick", "--out", str(tmp_path)]) == 0
    data = json.loads((tmp_path / "results.json").read_text())
    case = data["cases"][0]
    assert (case["case"], case["frames"]) == ("all", 4)
    geometry = case["geometry"]["metrics"]
    assert set(geometry) == set(GEOMETRY)
    assert 0 < geometry["surface_mm"] < 15
    assert geometry["normal_degrees"] < 60
    assert case["metrics"]["silhouette_iou"] > 0.6
    assert case[REFINED]["metrics"]["psnr_hand_on_black"] >= case["metrics"]["psnr_hand_on_black"] - 0.1
    assert "| all | held out |" in (tmp_path / "results.md").read_text()
    assert main(["eval", "synthetic", "--sequence", "nothing"]) == 2
