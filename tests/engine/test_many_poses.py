"""Many poses at a time are drawn as each is alone, and the graph of them asks its device nothing."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from mass_engine import many_poses
from mass_engine.avatar import Avatar, row_pose
from mass_engine.camera import Camera
from mass_engine.deform.network import DeformationConfig
from mass_engine.deform.posing import PosableSurfels
from mass_engine.errors import BadArgumentError
from mass_engine.fitting.skin import Skin
from mass_engine.hand.pose import HandPose
from mass_engine.many_poses import ManyPoses, draw_images
from mass_engine.raster import RasterOptions
from mass_engine.surfel.binding import MeshBinding
from tests.engine.avatars import small_avatar
from tests.engine.pretended import nothing_of_the_host, painted, pretend_kernels


def rich_avatar() -> Avatar:
    """With detached surfels that move, and colours that change with the view."""
    avatar = small_avatar()
    skin = Skin.attached(MeshBinding.build(avatar.shape.model, 1, 0))
    skin = skin.with_detached(skin.sources[::3])
    skin.deformation = skin.new_deformation(avatar.shape.model, DeformationConfig(), 0)
    random = torch.Generator().manual_seed(0)
    with torch.no_grad():
        skin.deformation.head.uniform_(-0.1, 0.1, generator=random)
    look = replace(
        avatar.appearance,
        albedo=torch.rand(skin.count, 3, generator=random),
        opacity_logits=torch.full((skin.count,), 3.0),
        sh=0.1 * torch.randn(skin.count, 3, 3, generator=random),
    )
    return replace(avatar, skin=skin, appearance=look)


def poses_of(avatar: Avatar, count: int) -> HandPose:
    random = torch.Generator().manual_seed(1)
    start = avatar.frames.pose
    return HandPose(
        start.betas.expand(count, -1),
        start.global_orient + 0.3 * torch.randn(count, 3, generator=random),
        0.3 * torch.randn(count, 45, generator=random),
        start.transl + 0.02 * torch.randn(count, 3, generator=random),
        start.side,
    )


def cameras(avatar: Avatar, count: int) -> list[Camera]:
    turned = torch.eye(4)
    turned[:3, 3] = torch.tensor([0.01, -0.02, 0.1])
    return [avatar.camera, replace(avatar.camera, world_to_camera=turned)] * ((count + 1) // 2)


@pytest.mark.parametrize("batch", [1, 3, 8])
def test_each_pose_is_drawn_as_alone(batch: int) -> None:
    avatar, count = rich_avatar(), 5
    poses, views = poses_of(avatar, count), cameras(avatar, count)[:count]
    options = RasterOptions(cull_backfaces=True, outputs="all", distortion_range=(0.2, 0.9))
    size = avatar.camera.width, avatar.camera.height
    many = ManyPoses(avatar.shape, avatar.posable(), *size, torch.device("cpu"), batch, options)
    drawn = [(means.clone(), out) for means, out in many.render(poses, views)]
    assert len(drawn) == count
    for row, (means, out) in enumerate(drawn):
        pose = row_pose(poses, row)
        alone = avatar.render_pose(pose, views[row], options)
        for name in ("rgb", "alpha", "depth", "normal"):
            error = (getattr(out, name) - getattr(alone, name)).abs()
            assert float((error > 1e-3).float().mean()) < 0.002, name
        torch.testing.assert_close(means, avatar.posed(pose).attached.means[0], atol=1e-6, rtol=0)


def test_pictures_of_other_sizes_and_batches_too_large_are_refused() -> None:
    avatar = small_avatar()
    many = ManyPoses(avatar.shape, avatar.posable(), 160, 120, torch.device("cpu"), 2)
    with pytest.raises(BadArgumentError, match="3 poses"):
        many.draw(poses_of(avatar, 3), cameras(avatar, 3)[:3])
    with pytest.raises(BadArgumentError, match="80x60"):
        many.draw(poses_of(avatar, 1), [avatar.camera.resized(80, 60)])
    with pytest.raises(BadArgumentError, match="batch of 0"):
        ManyPoses(avatar.shape, avatar.posable(), 160, 120, torch.device("cpu"), 0)


@pytest.mark.parametrize("channel", ["rgb", "depth", "normal"])
def test_images_come_in_the_order_of_their_poses(channel: Any) -> None:
    avatar = rich_avatar()
    poses = [avatar.frames.pose, poses_of(avatar, 1)]
    views = [avatar.camera, avatar.camera.resized(80, 60)]
    images = list(draw_images(avatar, poses, views, channel, torch.device("cpu")))
    assert [tuple(image.alpha.shape) for image in images] == [(120, 160), (60, 80)]
    for image, pose, view in zip(images, poses, views, strict=True):
        assert torch.equal(image.values, avatar.image(pose, view, channel).values)


def test_the_graph_asks_its_device_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    avatar = rich_avatar()
    surfels = avatar.posable()
    pretend_kernels(monkeypatch)
    monkeypatch.setattr(many_poses, "rasterize", painted)
    monkeypatch.setattr(PosableSurfels, "__post_init__", lambda _: None)  # looks at values, before
    many = ManyPoses(avatar.shape, surfels, 160, 120, torch.device("meta"), 2)
    many._draw()  # what never changes is made once
    with nothing_of_the_host():
        drawn = many._draw()
    assert [tuple(out.rgb.shape) for _, out in drawn] == [(120, 160, 3)] * 2
