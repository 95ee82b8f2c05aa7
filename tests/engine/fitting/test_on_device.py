"""Passes over a scene that is elsewhere: every tensor they make is there, too."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from mass_engine.fitting import subject
from mass_engine.fitting.capacity import best_pixels
from mass_engine.fitting.evidence import Scene, frame_gains, gather
from mass_engine.fitting.skin import Skin
from mass_engine.fitting.subject import Appearance
from tests.engine.fitting.test_static_pass import learned, odd_scene
from tests.engine.pretended import painted, pretend_kernels

META = torch.device("meta")


@pytest.fixture
def elsewhere(monkeypatch: pytest.MonkeyPatch) -> tuple[Scene, Skin, Appearance]:
    """A scene on "meta", and surfels of the host."""
    scene = odd_scene()
    skin, look = learned(scene)
    pretend_kernels(monkeypatch)
    monkeypatch.setattr(subject, "rasterize", painted)
    return replace(scene.to(META), compute=META), skin, look


def test_colours_are_gathered_where_the_scene_is(elsewhere: tuple[Scene, Skin, Appearance]) -> None:
    scene, skin, look = elsewhere
    found = gather(scene, skin, look.light, 160, scene.trained)
    assert {value.device.type for value in vars(found).values()} == {"meta"}
    assert found.albedo.shape == (skin.count, 3)


def test_gains_and_pixels_are_found_where_the_scene_is(elsewhere: tuple[Scene, Skin, Appearance]) -> None:
    scene, skin, look = elsewhere
    gains, pixels = frame_gains(scene, skin, look, 160), best_pixels(scene, skin, 160)
    assert (gains.device, pixels.device) == (META, META)
    assert gains.shape == scene.gains.shape


def test_on_the_cpu_nothing_is_copied() -> None:
    scene = odd_scene()
    skin, look = learned(scene)
    assert scene.at_work() is scene
    assert skin.to("cpu") is skin
    assert look.to("cpu") is look
    assert skin.binding.to("cpu") is skin.binding
    assert scene.shape.to("cpu") is scene.shape


def test_a_copy_elsewhere_has_weights_of_its_own_and_gives_them_back() -> None:
    scene = odd_scene()
    skin, look = learned(scene)
    assert skin.deformation is not None
    copied = skin.deformation.copied_to("cpu")
    with torch.no_grad():
        copied.head.add_(1.0)
        look.albedo.fill_(0.25)
    other = replace(skin, deformation=copied)
    assert not torch.equal(skin.deformation.head, copied.head)
    residuals = [one(torch.zeros(1, 45), torch.zeros(1, 10)).offset for one in (skin.deformation, copied)]
    assert not torch.equal(*residuals)
    skin.take(other)
    assert torch.equal(skin.deformation.head, copied.head)
    taken = Appearance.plain(skin.count, look.light, 3)
    taken.take(look)
    assert torch.equal(taken.albedo, look.albedo)
    assert torch.equal(taken.sh, look.sh)
