"""The step with fixed shapes does what the step operator by operator does, and asks its device nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from mass_engine.deform.network import DeformationConfig
from mass_engine.deform.static import StaticResiduals
from mass_engine.fitting import static_pass, subject
from mass_engine.fitting.evidence import Scene
from mass_engine.fitting.guard import Guard
from mass_engine.fitting.skin import Skin
from mass_engine.fitting.static_pass import FrameStack, StaticSteps, StepGuard
from mass_engine.fitting.subject import Appearance
from mass_engine.fitting.surfel_fit import SurfelFit, SurfelPass, SurfelWeights
from mass_engine.fitting.surfel_loss import shaped_options, surfel_loss
from mass_engine.fitting.surfel_steps import EagerSteps, Visit, groups_of
from mass_engine.tracking.segmentation import IGNORE
from tests.engine.fitting.test_surfel_fit import started, thick_scene
from tests.engine.pretended import nothing_of_the_host, painted, pretend_kernels

LOOKS = SurfelPass(200, 2)
SHAPES = SurfelPass(200, 2, geometry=True)
VIEWS = SurfelPass(160, 2, rate=0.7, harmonics=True)
SETTLES = SurfelPass(160, 2, settle=True)


def odd_scene() -> Scene:
    """Pictures of several sizes, one partly ignored, one cut close; a frame's gain; two validate."""
    scene = thick_scene()
    views = list(scene.views)
    windows = {0: (30, 20, 120, 131), 1: (0, 0, 200, 150), 3: (48, 28, 90, 110)}
    for row, (x, y, width, height) in windows.items():
        view, box = views[row], (slice(y, y + height), slice(x, x + width))
        camera = view.camera.crop(x, y, width, height)
        views[row] = replace(
            view, rgb=view.rgb[box], labels=view.labels[box].copy(), camera=camera, _levels={}, _outline=None
        )
    views[1].labels[-40:, :] = IGNORE
    scene.views = views
    scene.gains = torch.ones(8, 3)
    scene.gains[3] = torch.tensor([1.1, 1.0, 0.9])
    return scene


def learned(scene: Scene) -> tuple[Skin, Appearance]:
    """Surfels with harmonics and a deformation that does something."""
    skin, look = started(scene)
    skin.deformation = skin.new_deformation(scene.shape.model, DeformationConfig(), 0)
    random = torch.Generator().manual_seed(3)
    with torch.no_grad():
        skin.deformation.head.uniform_(-0.1, 0.1, generator=random)
    skin.static = StaticResiduals.none(torch.ones(skin.detached_from))
    skin.static.offset.uniform_(-0.2, 0.2, generator=random)
    look.sh = 0.05 * torch.randn(skin.count, 3, 3, generator=random)
    return skin, look


def parameters(skin: Skin, look: Appearance, stage: SurfelPass) -> list[tuple[float, Tensor]]:
    groups = list(groups_of(skin, look, stage, shading=True))
    for _, value in groups:
        value.requires_grad_(True)
    return groups


def eager_loss(
    fitter: SurfelFit, skin: Skin, look: Appearance, stage: SurfelPass, row: int, background: Tensor
) -> Tensor:
    scene, options = fitter.scene, fitter.scene.raster
    if stage.geometry:
        options = shaped_options(options, float(scene.table.values["transl"][row, 2]))
    frame, surfels = fitter.frame(row, stage.side), scene.surfels(skin, row)
    return surfel_loss(
        look, skin, frame, surfels, background, options, fitter.weights, stage.dssim, stage.geometry
    )[0]


@pytest.mark.parametrize("stage", [LOOKS, SHAPES, VIEWS, SETTLES])
def test_losses_and_gradients_are_those_of_the_unpadded_frames(stage: SurfelPass) -> None:
    scene = odd_scene()
    skin, look = learned(scene)
    groups = parameters(skin, look, stage)
    values = [value for _, value in groups]
    fitter, rows = SurfelFit(scene), scene.trained
    steps = StaticSteps(scene, skin, look, stage, SurfelWeights(), groups, rows)
    background = torch.tensor([0.2, 0.5, 0.9])
    for place, row in enumerate(rows):
        wanted = eager_loss(fitter, skin, look, stage, row, background)
        found = steps.loss(torch.tensor([place]), background)
        torch.testing.assert_close(found, wanted, rtol=2e-5, atol=1e-6)
        ours, theirs = (torch.autograd.grad(loss, values) for loss in (found, wanted))
        for mine, other in zip(ours, theirs, strict=True):
            scale = float(other.abs().max())
            torch.testing.assert_close(mine, other, rtol=1e-3, atol=2e-5 * scale + 1e-9)


def after(
    steps: type[EagerSteps] | type[StaticSteps], stage: SurfelPass
) -> tuple[list[Tensor], list[Tensor], int]:
    """What a visit of some frames makes of the parameters; what they were; how often it went back."""
    scene = odd_scene()
    skin, look = learned(scene)
    groups = parameters(skin, look, stage)
    before = [value.detach().clone() for _, value in groups]
    random = torch.Generator().manual_seed(5)
    rows = [scene.trained[int(k)] for k in torch.randperm(6, generator=random)]
    backgrounds = [torch.rand(3, generator=random) for _ in rows]
    plan = Visit(rows, backgrounds, [stage.rate * 0.4 ** (k / 6) for k in range(6)])
    told: list[int] = []
    fitter = SurfelFit(scene)
    taken: EagerSteps | StaticSteps
    if steps is StaticSteps:
        taken = StaticSteps(scene, skin, look, stage, SurfelWeights(), groups, scene.trained)
    else:
        taken = EagerSteps(
            skin,
            groups,
            stage.geometry,
            lambda row, behind: eager_loss(fitter, skin, look, stage, row, behind),
        )
    taken.visit(plan, told.append)
    assert told == [1, 2, 3, 4, 5, 6]
    return [value.detach() for _, value in groups], before, taken.undone


@pytest.mark.parametrize("stage", [LOOKS, SHAPES, VIEWS, SETTLES])
def test_a_visit_goes_where_the_eager_one_goes(stage: SurfelPass) -> None:
    wanted, before, _ = after(EagerSteps, stage)
    found, _, undone = after(StaticSteps, stage)
    assert undone == 0
    for mine, other, start in zip(found, wanted, before, strict=True):
        moved = float((other - start).norm())
        # Adam takes the sign of a gradient near zero for a whole step, so single numbers may differ.
        assert float((mine - other).norm()) <= 0.02 * moved + 1e-9


def test_a_whole_pass_by_static_steps_reaches_the_same_validation() -> None:
    reached = []
    for static in (False, True):
        scene = odd_scene()
        skin, look = learned(scene)
        result = SurfelFit(scene, static=static).run(skin, look, SurfelPass(200, 3), 0)
        reached.append((result.visits, result.before, result.after))
        assert not look.albedo.requires_grad
    assert reached[0][0] == reached[1][0]
    assert reached[0][1] == reached[1][1]
    assert reached[1][2] == pytest.approx(reached[0][2], abs=0.02)
    assert reached[1][2] > reached[1][1]


def test_a_visit_that_diverges_is_taken_back_and_the_next_goes_at_half_the_rate() -> None:
    scene = odd_scene()
    skin, look = learned(scene)
    groups = parameters(skin, look, LOOKS)
    steps = StaticSteps(scene, skin, look, LOOKS, SurfelWeights(), groups, scene.trained)
    before = [value.detach().clone() for _, value in groups]
    backgrounds = [torch.zeros(3) for _ in scene.trained]
    backgrounds[2] = torch.full((3,), torch.nan)
    rates = [1.0] * len(scene.trained)
    steps.visit(Visit(scene.trained, backgrounds, rates), lambda _: None)
    assert steps.undone == 1
    for (_, value), start in zip(groups, before, strict=True):
        assert torch.equal(value.detach(), start)
    steps.visit(Visit(scene.trained, [torch.zeros(3)] * len(rates), rates), lambda _: None)
    assert steps.undone == 1
    assert [float(group["lr"]) for group in steps._optimizer.param_groups] == pytest.approx(
        [0.5 * rate for rate in sorted({rate for rate, _ in groups})]
    )


@pytest.mark.parametrize("bad", [(), (20,), (20, 40), (3,)])
def test_the_guard_on_the_device_judges_as_the_one_on_the_host(bad: Sequence[int]) -> None:
    random = torch.Generator().manual_seed(1)
    value = torch.zeros(1, requires_grad=True)
    host, device = Guard([value]), StepGuard(torch.device("cpu"))
    for step in range(100):
        loss = torch.rand((), generator=random) + 0.5 + (100 if step in bad else 0)
        value.grad = torch.ones(1)
        assert bool(device.judge(loss, torch.tensor(False))) == host.good(loss)
    assert not bool(device.diverged)


@pytest.mark.parametrize("how", ["loss", "gradient", "leaps"])
def test_after_a_divergence_no_step_of_the_visit_is_taken(how: str) -> None:
    guard = StepGuard(torch.device("cpu"))
    fine, false = torch.tensor(1.0), torch.tensor(False)
    assert all(bool(guard.judge(fine, false)) for _ in range(10))
    if how == "loss":
        guard.judge(torch.tensor(torch.nan), false)
    elif how == "gradient":
        guard.judge(fine, torch.tensor(True))
    else:
        assert not any(bool(guard.judge(torch.tensor(1e3), false)) for _ in range(3))
    assert bool(guard.diverged)
    assert not bool(guard.judge(fine, false))
    guard.begin_visit()
    assert bool(guard.judge(fine, false))


def test_frames_of_many_sizes_lie_in_one_stack() -> None:
    scene = odd_scene()
    skin, _ = started(scene)
    stack = FrameStack.of(scene, skin, scene.trained, 200)
    assert stack.hand.shape[1] % 16 == stack.hand.shape[2] % 16 == 0
    for place, row in enumerate(scene.trained):
        level = scene.level(row, 200)
        frame = stack.frame(torch.tensor([place]))
        height, width = level.hand.shape
        for name in ("rgb", "hand", "valid", "colored"):
            padded = getattr(frame.level, name)
            assert torch.equal(padded[:height, :width], getattr(level, name))
            assert not bool(padded[height:].any())
            assert not bool(padded[:, width:].any())
        assert torch.equal(frame.level.camera.K, level.camera.K)
    assert stack.nbytes > stack.rgb.numel()


@pytest.mark.parametrize("stage", [LOOKS, SHAPES, VIEWS, SETTLES])
def test_a_step_asks_its_device_nothing_and_takes_nothing_from_the_host(
    stage: SurfelPass, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = odd_scene()
    skin, look = learned(scene)
    scene, skin, look = scene.to("meta"), skin.to("meta"), look.to("meta")
    monkeypatch.setattr(subject, "rasterize", painted)
    pretend_kernels(monkeypatch)
    monkeypatch.setattr(static_pass, "_middle", lambda _: 0.35)
    monkeypatch.setattr(static_pass, "_adam", lambda *_: (None, []))
    groups = parameters(skin, look, stage)
    steps = StaticSteps(scene, skin, look, stage, SurfelWeights(), groups, scene.trained)
    guard, turn = StepGuard(torch.device("meta")), torch.zeros(1, dtype=torch.long, device="meta")
    with nothing_of_the_host():
        loss = steps.loss(turn, torch.zeros(3, device="meta"))
        loss.backward()
        guard.judge(loss, torch.zeros((), dtype=torch.bool, device="meta"))
    for _, value in groups:
        assert value.grad is not None
        assert value.grad.shape == value.shape
