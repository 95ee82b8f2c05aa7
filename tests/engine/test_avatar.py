"""An avatar's picture comes from the compiled pass; it is the fit's own picture."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from mass_engine.avatar import Avatar
from mass_engine.deform.static import StaticResiduals
from mass_engine.errors import EngineError
from mass_engine.fitting.subject import Appearance, render_row
from mass_engine.raster import RasterOptions
from tests.engine.avatars import small_avatar


def colorful() -> Avatar:
    """The small avatar with part of its surfels, and every kind of colour."""
    avatar = small_avatar()
    generator = torch.Generator().manual_seed(4)
    kept = torch.zeros(avatar.skin.count, dtype=torch.bool)
    kept[::3] = True
    count = int(kept.sum())
    look = Appearance(
        torch.rand(count, 3, generator=generator),
        torch.randn(count, generator=generator) + 2,
        torch.randn(count, 8, 3, generator=generator) * 0.1,
        avatar.appearance.light + torch.randn(9, 3, generator=generator) * 0.1,
    )
    skin = avatar.skin.pick(kept, avatar.shape.model)
    skin.static = StaticResiduals.none(torch.arange(skin.detached_from) % 5 > 0)
    for value in skin.static.parameters().values():
        value.copy_(0.3 * torch.randn(value.shape, generator=generator))
    return replace(avatar, skin=skin, appearance=look)


def test_the_compiled_picture_is_the_one_the_fit_sees() -> None:
    avatar = colorful()
    options = RasterOptions(cull_backfaces=True)
    for spec in ("fist", "frame:0"):
        pose = avatar.resolve_pose(spec)
        got = avatar.render_pose(pose, avatar.camera, options)
        bones = avatar.skin.bones
        expected = render_row(avatar.appearance, avatar.posed(pose), 0, bones, avatar.camera, options)
        assert float(expected.alpha.max()) > 0.9
        # A surfel at its alpha cut may be blended in one and not in the other: one part in 255.
        assert float((got.rgb - expected.rgb).abs().max()) < 5e-3
        assert float((got.rgb - expected.rgb).abs().mean()) < 1e-6
        assert float((got.depth - expected.depth).abs().mean()) < 1e-5


def test_a_file_of_the_format_before_static_residuals_is_read(tmp_path: Path) -> None:
    avatar = colorful()
    avatar.skin.static = None
    file = tmp_path / "avatar.safetensors"
    avatar.save(file)
    with safe_open(file, framework="pt") as opened:
        metadata = {**opened.metadata(), "format": "3"}
        tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118 - not a dict
    save_file(tensors, file, metadata)
    assert Avatar.load(file).skin.static is None
    save_file(tensors, file, {**metadata, "format": "2"})
    with pytest.raises(EngineError, match=r"avatar\.corrupt"):
        Avatar.load(file)


def test_a_changed_avatar_is_compiled_anew() -> None:
    avatar = colorful()
    pose = avatar.resolve_pose("rest")
    before = avatar.render_pose(pose, avatar.camera)
    dark = replace(
        avatar, appearance=replace(avatar.appearance, albedo=torch.zeros_like(avatar.appearance.albedo))
    )
    assert float(dark.render_pose(pose, avatar.camera).rgb.sum()) < float(before.rgb.sum())
