"""Exposure that drifts over a clip: found before the fit, and nothing changed where it does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from mass_engine.errors import BadArgumentError
from mass_engine.fitting.components import Components
from mass_engine.fitting.exposure import Drift, between, find_drift
from mass_engine.fitting.schedule import schedule_for
from mass_engine.fitting.surfel_fit import SurfelPass
from mass_engine.fitting.trainer import FitResult, fit_hand
from mass_engine.fitting.views import View
from mass_engine.hand.builtin import load_builtin
from mass_engine.tracking.segmentation import BACKGROUND, IGNORE
from tests.engine.fitting.clips import CAMERA, make_views, true_poses

FRAMES = 9
HELDOUT = frozenset({2, 6})


def gains(*stops: float) -> Tensor:
    """A rise and fall by so many stops in each channel [F,3]."""
    share = torch.sin(torch.pi * torch.arange(FRAMES) / (FRAMES - 1)).unsqueeze(-1)
    return 2 ** (-torch.tensor(stops).expand(3) / 2.2 * share)


def lit(views: list[View], factors: Tensor) -> list[View]:
    """The views under gains [F,3]."""
    pictures = [(view.rgb * factors[row].numpy()).round().clip(0, 255) for row, view in enumerate(views)]
    return [
        replace(view, rgb=rgb.astype(np.uint8), _levels={}) for view, rgb in zip(views, pictures, strict=True)
    ]


def steady() -> list[View]:
    return make_views(true_poses(FRAMES), HELDOUT)


def drift_of(views: list[View]) -> Drift:
    return find_drift(views, true_poses(FRAMES), load_builtin("right"), CAMERA)


def referred(factors: Tensor) -> Tensor:
    """To the median of the training frames."""
    known = [row for row in range(FRAMES) if row not in HELDOUT]
    return factors / factors[known].median(0).values


def hidden(views: list[View]) -> list[View]:
    """The views with nothing known about what is around the hand."""
    return [
        replace(view, labels=np.where(view.labels == BACKGROUND, IGNORE, view.labels), _levels={})
        for view in views
    ]


def test_steady_light_is_steady() -> None:
    for views, place in ((steady(), "surroundings"), (hidden(steady()), "hand")):
        found = drift_of(views)
        assert (found.seen_in, found.certain) == (place, False)


@pytest.mark.parametrize("stops", [(0.5,), (2.0,), (-0.4, 0.0, 0.8)], ids=str)
def test_surroundings_tell_the_drift(stops: tuple[float, ...]) -> None:
    true = gains(*stops)
    found = drift_of(lit(steady(), true))
    assert (found.seen_in, found.certain) == ("surroundings", True)
    known = [row for row in range(FRAMES) if row not in HELDOUT]
    torch.testing.assert_close(found.gains[known], referred(true)[known], atol=0.015, rtol=0)
    torch.testing.assert_close(found.gains, referred(true), atol=0.07, rtol=0)  # between two of few frames
    assert found.stops == pytest.approx(max(abs(value) for value in stops), rel=0.3)


def test_the_hand_tells_a_large_drift_where_nothing_is_around_it() -> None:
    true = gains(2.0)
    found = drift_of(hidden(lit(steady(), true)))
    assert (found.seen_in, found.certain) == ("hand", True)
    torch.testing.assert_close(found.gains, referred(true), atol=0.1, rtol=0)
    assert not drift_of(hidden(lit(steady(), gains(0.5)))).certain


def test_colours_of_heldout_frames_are_never_looked_at() -> None:
    views = lit(steady(), gains(1.0))
    other = [replace(v, rgb=255 - v.rgb, _levels={}) if v.heldout else v for v in views]
    for hide in (list, hidden):
        one, two = drift_of(hide(views)), drift_of(hide(other))
        assert torch.equal(one.gains, two.gains)
        assert one.stops == two.stops


def test_surroundings_that_change_alone_are_no_exposure() -> None:
    views, dark = steady(), lit(steady(), gains(1.0))
    mixed = [
        replace(view, rgb=np.where(view.labels[..., None] == BACKGROUND, other.rgb, view.rgb), _levels={})
        for view, other in zip(views, dark, strict=True)
    ]
    found = drift_of(mixed)
    assert (found.seen_in, found.certain) == ("nothing", False)
    assert bool((found.gains == 1).all())


def test_a_clip_that_shows_nothing_has_no_drift() -> None:
    views = [replace(v, labels=np.full_like(v.labels, IGNORE), _levels={}) for v in steady()]
    found = drift_of(views)
    assert (found.seen_in, found.certain) == ("nothing", False)
    assert bool((found.gains == 1).all())


def test_rows_between_others_are_linear_in_time() -> None:
    views = steady()
    views[2].time = 0.75 * views[3].time + 0.25 * views[1].time
    known = [row for row in range(FRAMES) if row not in HELDOUT]
    logs = torch.randn(len(known), 3, generator=torch.Generator().manual_seed(0))
    filled = between(logs, views, known)
    assert torch.equal(filled[known], logs)
    torch.testing.assert_close(filled[2], 0.25 * filled[1] + 0.75 * filled[3])


def fitted(views: list[View], exposure: str) -> FitResult:
    parts = Components(exposure=exposure)
    whole = schedule_for("draft", parts)
    schedule = replace(
        whole,
        geometry=tuple(replace(stage, visits=1) for stage in whole.geometry),
        outline=whole.outline[:1],
        texture=whole.texture[:1],
        deforming=(),
        detached=False,
        appearance=(SurfelPass(200, 1),),
        heldout=(),
        adaptive=False,
    )
    model = load_builtin("right")
    return fit_hand(views, true_poses(FRAMES), model, CAMERA, schedule, 0, lambda *_: None, parts)


def test_a_fit_is_the_same_in_steady_light_and_undoes_a_drift() -> None:
    true = gains(2.0)
    off, auto = fitted(steady(), "off"), fitted(steady(), "auto")
    for name in ("albedo", "opacity_logits", "light"):
        assert torch.equal(getattr(off.avatar.appearance, name), getattr(auto.avatar.appearance, name)), name
    assert torch.equal(off.avatar.frames.pose.hand_pose, auto.avatar.frames.pose.hand_pose)
    assert bool((auto.avatar.frames.gains == 1).all())
    assert auto.state.notes["exposure"]["gains"] is False
    assert auto.state.notes["exposure"]["drift_stops"] < 0.25
    assert off.state.notes["exposure"] == {"drift_stops": None, "seen_in": None, "gains": False}

    spoilt, undone = fitted(lit(steady(), true), "off"), fitted(lit(steady(), true), "auto")
    assert undone.state.notes["exposure"]["gains"] is True
    assert undone.state.notes["exposure"]["drift_stops"] == pytest.approx(2.0, rel=0.3)
    torch.testing.assert_close(undone.avatar.frames.gains, referred(true), atol=0.1, rtol=0)
    # At the median frame's exposure the hand looks as it does in steady light.
    median = float((true / referred(true))[0, 0])

    def apart(result: FitResult) -> float:
        same = auto.avatar.appearance.albedo * median
        return float((result.avatar.appearance.albedo - same).abs().mean())

    assert apart(undone) < 0.02
    assert apart(spoilt) > 2 * apart(undone)


def test_exposure_is_on_off_or_as_needed() -> None:
    assert Components().exposure == "auto"
    assert Components(exposure=True) == Components(exposure="on")
    assert Components(exposure=False) == Components(exposure="off")
    with pytest.raises(BadArgumentError) as caught:
        Components(exposure="often")
    assert caught.value.code == "options.invalid"
