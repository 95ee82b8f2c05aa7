"""Descent over surfels: detached surfels learn a surface that is not the mesh's, and no more."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from mass_engine.deform.network import DeformationConfig
from mass_engine.deform.static import SCALE_BOUND, StaticResiduals
from mass_engine.fitting.evidence import Scene, fill_unseen, frame_gains, gather
from mass_engine.fitting.poses import PoseTable
from mass_engine.fitting.skin import Skin
from mass_engine.fitting.subject import Appearance, Shape, vertex_normals
from mass_engine.fitting.surfel_fit import SurfelFit, SurfelPass, SurfelWeights
from mass_engine.hand.builtin import load_builtin
from mass_engine.raster import RasterOptions
from mass_engine.surfel.binding import MeshBinding
from mass_engine.surfel.shading import white_light
from tests.engine.fitting.clips import make_views, true_poses


def thick_scene(thicker: float = 0.0015) -> Scene:
    """Views of a hand ``thicker`` metres than the model, true poses; two frames to validate."""
    model = load_builtin("right")
    thick = replace(model, template=model.template + thicker * vertex_normals(model.template, model.faces))
    poses = true_poses(8)
    shape = Shape.mean(model, torch.zeros(10))
    options = RasterOptions(cull_backfaces=True)
    views = make_views(poses, model=thick)
    return Scene(views, PoseTable(poses), shape, options, torch.ones(8, 3), [2, 6])


def started(scene: Scene) -> tuple[Skin, Appearance]:
    skin = Skin.attached(MeshBinding.build(scene.shape.model, 1, 0))
    skin = skin.with_detached(skin.sources)
    look = Appearance.plain(skin.count, white_light())
    look.albedo = fill_unseen(gather(scene, skin, look.light, 200, scene.trained), skin, 0.5)
    return skin, look


@pytest.mark.parametrize("binding", ["none", "paper", "additive"])
def test_detached_surfels_fill_what_the_mesh_lacks(binding: str) -> None:
    scene = thick_scene()
    skin, look = started(scene)
    skin.deformation = skin.new_deformation(scene.shape.model, DeformationConfig(), 0)
    fitter = SurfelFit(scene, SurfelWeights(binding=binding, binding_weight=0.01, still=1e-4))
    result = fitter.run(skin, look, SurfelPass(200, 6, geometry=True), 0)
    assert result.after > result.before + 0.05
    residuals = scene.surfels(skin, 0).residuals
    assert residuals is not None
    assert float(residuals.offset[..., 2].mean()) > 1e-5, "outward, on the mean"
    assert not bool(residuals.mask_logit.any()), "the mask belongs to stage two"


def test_attached_surfels_settle_on_a_hand_thinner_than_the_mesh() -> None:
    scene = thick_scene(-0.0015)
    reached = []
    for static in (None, StaticResiduals.none(torch.ones(10288))):
        skin, look = started(scene)
        count = skin.detached_from
        skin = Skin(skin.binding, skin.sources[:count], count, static=static)
        look = Appearance(look.albedo[:count], look.opacity_logits[:count], look.sh[:count], look.light)
        reached.append(SurfelFit(scene).run(skin, look, SurfelPass(200, 4, settle=True), 0).after)
        if static is not None:
            assert len(static.offset) == count
            assert float(static.offset[:, 2].mean()) < -0.02, "inward, millimetres"
            assert float(static.residuals(1).log_scale.abs().max()) < SCALE_BOUND
    assert reached[1] > reached[0] + 0.5


def test_binding_holds_the_surfels_near_the_mesh() -> None:
    away = []
    for weight in (0.0, 30.0):
        scene = thick_scene()
        skin, look = started(scene)
        skin.deformation = skin.new_deformation(scene.shape.model, DeformationConfig(), 0)
        weights = SurfelWeights(binding_weight=weight, still=0.0, delta=1e-5)
        SurfelFit(scene, weights).run(skin, look, SurfelPass(200, 3, geometry=True), 0)
        residuals = scene.surfels(skin, 0).residuals
        assert residuals is not None
        away.append(float(residuals.offset.norm(dim=-1).mean()))
    assert away[1] < 0.8 * away[0]


def test_stage_two_leaves_the_geometry_alone() -> None:
    scene = thick_scene()
    scene.validation = []  # every visit counts
    skin, look = started(scene)
    skin.deformation = skin.new_deformation(scene.shape.model, DeformationConfig(), 0)
    fitter = SurfelFit(scene)
    fitter.run(skin, look, SurfelPass(200, 1, geometry=True), 0)
    before = scene.surfels(skin, 3)
    fitter.run(skin, look, SurfelPass(200, 1), 1)
    after = scene.surfels(skin, 3)
    assert torch.equal(before.attached.means, after.attached.means)
    assert torch.equal(before.attached.tangents, after.attached.tangents)
    assert before.residuals is not None
    assert after.residuals is not None
    assert not bool(before.residuals.mask_logit.any())
    assert bool(after.residuals.mask_logit.any())


def test_a_pass_ends_when_validation_gains_nothing() -> None:
    scene = thick_scene()
    skin, look = started(scene)
    fitter = SurfelFit(scene)
    first = fitter.run(skin, look, SurfelPass(200, 12), 0)
    again = fitter.run(skin, look, SurfelPass(200, 12, rate=1e-6), 0)
    assert first.visits < 12
    assert again.visits == 1


def test_gains_find_the_exposure_of_every_frame_but_the_heldout() -> None:
    scene = thick_scene()
    scene.views = make_views(true_poses(8), frozenset({4}))
    true = torch.linspace(0.8, 1.25, 8).log()
    for row, view in enumerate(scene.views):
        bright = torch.from_numpy(view.rgb).float() * float(true[row].exp()) * 0.7
        view.rgb = bright.clamp(0, 255).byte().numpy()
    skin, look = started(scene)
    found = frame_gains(scene, skin, look, 200).log().mean(1)
    known = [row for row in range(8) if row != 4]
    torch.testing.assert_close(found[known], true[known] - true[known].mean(), atol=0.05, rtol=0)
    assert abs(float(found[4] - (found[3] + found[5]) / 2)) < 1e-5, "between its neighbours"
    # What is found is beside what is known: nothing is left once the colours are without their gains.
    scene.gains = frame_gains(scene, skin, look, 200)
    skin, look = started(scene)
    rest = frame_gains(scene, skin, look, 200).log()
    assert float(rest.abs().max()) < 0.2 * float(true.abs().max())


def test_a_pick_of_detached_surfels_leaves_the_skin_as_it_is() -> None:
    scene = thick_scene()
    skin, _ = started(scene)
    skin.deformation = skin.new_deformation(scene.shape.model, DeformationConfig(), 0)
    before = scene.surfels(skin, 0).attached.means
    kept = torch.ones(skin.count, dtype=torch.bool)
    kept[::3] = False
    picked = skin.pick(kept, scene.shape.model)
    assert torch.equal(scene.surfels(skin, 0).attached.means, before)
    assert torch.equal(scene.surfels(picked, 0).attached.means, before[:, kept])
