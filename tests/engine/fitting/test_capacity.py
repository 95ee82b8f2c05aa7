"""How much model: thinned faces keep their colour and leave no holes; harmonics follow the view's spread."""

from __future__ import annotations

import torch

from mass_engine.fitting import capacity
from mass_engine.fitting.evidence import Evidence, Scene
from mass_engine.fitting.poses import PoseTable
from mass_engine.fitting.skin import Skin
from mass_engine.fitting.subject import Appearance, Shape, render_row
from mass_engine.hand.builtin import load_builtin
from mass_engine.raster import RasterOptions
from mass_engine.surfel.binding import MeshBinding
from mass_engine.surfel.shading import white_light
from tests.engine.fitting.clips import CAMERA, make_views, true_poses


def scene() -> Scene:
    poses = true_poses(4)
    model = load_builtin("right")
    shape = Shape.mean(model, torch.zeros(10))
    options = RasterOptions(cull_backfaces=True)
    return Scene(make_views(poses), PoseTable(poses), shape, options, torch.ones(4, 3))


def evidence(skin: Skin, seen: torch.Tensor, albedo: torch.Tensor) -> Evidence:
    return Evidence(seen, torch.zeros(skin.count), torch.zeros(skin.count), albedo)


def test_faces_of_one_colour_or_unseen_get_one_surfel() -> None:
    binding = MeshBinding.build(load_builtin("right"), 0, 1, widened=True)
    skin = Skin.attached(binding)
    faces = skin.count // 4
    albedo = torch.full((faces, 4, 3), 0.5)
    albedo[::2, 1] = 0.7  # every second face has two colours
    seen = torch.ones(faces, 4)
    seen[1] = 0.0
    thin, merged, why = capacity.thin(
        skin, evidence(skin, seen.flatten(), albedo.flatten(0, 1)), torch.full((faces,), 100.0)
    )
    odd = faces // 2
    assert why == {"unseen": 1, "small": 0, "one_color": odd - 1}
    assert thin.count == 4 * (faces - odd) + odd
    assert float(merged.hand.sum()) == float(seen.sum())
    wide = thin.sources % binding.per_face == binding.per_face - 1
    assert (merged.albedo[wide][1:] == 0.5).all()


def test_small_faces_get_one_surfel() -> None:
    binding = MeshBinding.build(load_builtin("right"), 0, 1, widened=True)
    skin = Skin.attached(binding)
    faces = skin.count // 4
    albedo = torch.rand(skin.count, 3, generator=torch.Generator().manual_seed(0))
    pixels = torch.full((faces,), 100.0)
    pixels[:7] = 0.5
    _, _, why = capacity.thin(skin, evidence(skin, torch.ones(skin.count), albedo), pixels)
    assert why == {"unseen": 0, "small": 7, "one_color": 0}


def test_a_thinned_hand_has_no_holes() -> None:
    place = scene()
    binding = MeshBinding.build(place.shape.model, 1, 1, widened=True)
    skin = Skin.attached(binding)
    albedo = torch.full((skin.count, 3), 0.5)
    thin, _, _ = capacity.thin(
        skin, evidence(skin, torch.ones(skin.count), albedo), torch.full((skin.count // 4,), 100.0)
    )
    assert thin.count == skin.count // 4
    with torch.no_grad():
        whole, sparse = (
            render_row(
                Appearance.plain(s.count, white_light()),
                place.surfels(s, 0),
                0,
                s.bones,
                CAMERA,
                place.raster,
            ).alpha
            for s in (skin, thin)
        )
    assert float(sparse[whole > 0.99].quantile(0.05)) > 0.9


def test_the_best_view_of_a_face_counts_its_pixels() -> None:
    place = scene()
    skin = Skin.attached(MeshBinding.build(place.shape.model, 0, 1, widened=True))
    pixels = capacity.best_pixels(place, skin, 200)
    hand = float((place.views[0].labels == 255).sum())
    assert 0.8 * hand < float(pixels.sum()) < 3 * hand
    assert float((pixels == 0).float().mean()) > 0.2, "the palm is never seen"


def test_harmonics_follow_the_spread_of_the_view() -> None:
    assert [capacity.harmonics_for(angle, 8) for angle in (2.0, 20.0, 80.0)] == [0, 3, 8]
    assert capacity.harmonics_for(80.0, 3) == 3
    assert 0 < capacity.view_spread(scene()) < 40
