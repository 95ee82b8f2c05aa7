"""Every channel of a render: its numbers and its picture."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from mass_engine.avatar import Avatar
from mass_engine.camera import Camera
from mass_engine.channels import (
    CHANNELS,
    Channel,
    ChannelImage,
    extract,
    parse_channel,
    raster_options,
)
from mass_engine.cli import main
from mass_engine.errors import BadArgumentError
from mass_engine.raster import rasterize
from mass_engine.rendering import render_frames, render_to_file
from mass_engine.surfel.inellipse import principal_tangents
from tests.engine.avatars import small_avatar

#: Every channel that shows the hand on a transparent ground.
ON_NOTHING: tuple[Channel, ...] = ("rgb", "depth", "normal", "distortion")


@pytest.fixture(scope="module")
def avatar() -> Avatar:
    return small_avatar()


@pytest.fixture(scope="module")
def run(avatar: Avatar, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    avatar.save(folder)
    return folder


def facing(normals: Tensor) -> Tensor:
    """Quaternions [N,4] that turn z to ``normals`` [N,3]."""
    half = normals + torch.tensor([0.0, 0.0, 1.0])
    axis = torch.linalg.cross(torch.tensor([[0.0, 0.0, 1.0]]).expand_as(half), half)
    return torch.cat([half[:, 2:], axis], -1)


def draw(
    means: Tensor, normals: Tensor, sigma: float, channel: Channel, size: int = 101, opacity: float = 1.0
) -> ChannelImage:
    """Round surfels with outward ``normals``, seen from the origin along z."""
    camera = Camera.from_fov(size, size, 40.0)
    count = len(means)
    out = rasterize(
        means,
        principal_tangents(torch.full((count, 2), sigma), facing(normals)),
        torch.full((count,), opacity),
        torch.full((count, 3), 0.5),
        camera,
        options=raster_options(channel, means, camera),
    )
    return extract(channel, out, means, camera)


def ball(channel: Channel) -> ChannelImage:
    """A ball of 5 cm, 30 cm away."""
    directions = torch.nn.functional.normalize(
        torch.randn(4000, 3, generator=torch.manual_seed(0)) + 1e-6, dim=-1
    )
    return draw(directions * 0.05 + torch.tensor([0.0, 0.0, 0.3]), directions, 0.004, channel)


def sheet(z: float, side: float, count: int = 15) -> Tensor:
    """Points [N,3] of a square of ``side`` metres across the axis."""
    line = torch.linspace(-side / 2, side / 2, count)
    x, y = torch.meshgrid(line, line, indexing="xy")
    return torch.stack([x.flatten(), y.flatten(), torch.full((count * count,), z)], -1)


def toward_camera(count: int) -> Tensor:
    return torch.tensor([[1e-4, 0.0, -1.0]]).expand(count, 3)


def lightness(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return cv2.cvtColor(picture[..., :3], cv2.COLOR_RGB2LAB)[..., 0].astype(np.uint8)


def test_colour_is_the_default_and_pictures_differ(avatar: Avatar) -> None:
    pictures = {channel: avatar.render("rest", "orbit:0,0", 96, 80, channel) for channel in CHANNELS}
    assert all(picture.shape == (80, 96, 4) and picture.dtype == np.uint8 for picture in pictures.values())
    assert np.array_equal(avatar.render("rest", "orbit:0,0", 96, 80), pictures["rgb"])
    assert len({picture.tobytes() for picture in pictures.values()}) == len(CHANNELS)
    for channel in ON_NOTHING:
        assert np.array_equal(pictures[channel][..., 3], pictures["rgb"][..., 3])
        assert (pictures[channel][pictures[channel][..., 3] == 0] == 0).all()
    assert 0.05 < (pictures["rgb"][..., 3] > 127).mean() < 0.9


def test_alpha_is_grey_and_opaque(avatar: Avatar) -> None:
    picture = avatar.render("rest", "orbit:0,0", 64, 64, "alpha")
    assert (picture[..., 3] == 255).all()
    assert (picture[..., :3] == picture[..., :1]).all()
    colour = avatar.render("rest", "orbit:0,0", 64, 64)
    assert np.array_equal(picture[..., 0], colour[..., 3])


def test_depth_is_in_metres_and_near_is_bright() -> None:
    image = ball("depth")
    depth, picture = image.numbers(), image.picture()
    assert abs(float(depth[50, 50]) - 0.25) < 0.003
    assert depth[0, 0] == 0
    seen = image.alpha.numpy() >= 0.5
    order = np.argsort(depth[seen])
    falling = lightness(picture)[seen][order].astype(int)
    assert (np.diff(falling) <= 2).all()  # darker with distance, but for the rounding of the colour table
    assert falling[0] > 220
    assert falling[-1] < 60


def test_depth_of_an_avatar_is_its_distance(avatar: Avatar) -> None:
    for distance in (0.3, 0.5):
        depth = avatar.view("rest", f"orbit:0,0,{distance}", 65, 65, "depth").numbers()
        hand = depth[depth > 0]
        assert abs(float(np.median(hand)) - distance) < 0.03
        assert float(hand.max() - hand.min()) < 0.2


def test_a_flat_depth_and_an_empty_picture_are_drawn() -> None:
    flat = draw(sheet(0.4, 0.1), toward_camera(225), 0.01, "depth").picture()
    assert (flat[flat[..., 3] > 250][:, :3] > 0).any()
    behind = torch.tensor([[0.0, 0.0, -1.0]])
    for channel in CHANNELS:
        empty = draw(behind, toward_camera(1), 0.01, channel)
        assert (empty.picture()[..., :3] == 0).all()
        assert empty.picture()[..., 3].max() == (255 if channel == "alpha" else 0)
        assert np.isfinite(empty.numbers()).all()


def test_normals_point_right_up_and_to_the_viewer() -> None:
    picture = ball("normal").picture().astype(int)
    assert (np.abs(picture[50, 50, :3] - [128, 128, 255]) <= 4).all()
    rows, columns = np.nonzero(picture[..., 3] > 250)
    left, right, top, bottom = columns.min(), columns.max(), rows.min(), rows.max()
    assert picture[50, left, 0] < 60
    assert picture[50, right, 0] > 195
    assert picture[top, 50, 1] > 195
    assert picture[bottom, 50, 1] < 60
    unit = picture[picture[..., 3] > 250][:, :3] / 127.5 - 1
    assert np.abs(np.linalg.norm(unit, axis=-1) - 1).max() < 0.02


def test_faint_normals_are_as_long_as_opaque_ones() -> None:
    faint = draw(torch.tensor([[0.0, 0.0, 0.5]]), toward_camera(1), 0.05, "normal", opacity=0.3)
    assert faint.picture()[50, 50].tolist() == [128, 128, 255, 76]
    assert abs(float(faint.numbers()[50, 50, 2]) + 0.3) < 1e-3


def test_distortion_shows_where_surfels_lie_apart() -> None:
    """A sheet that lets about half of the light through, before the right half of another one."""
    front = sheet(0.35, 0.1) + torch.tensor([0.05, 0.0, 0.0])
    means = torch.cat([front, sheet(0.4, 0.2, 30)])
    image = draw(means, toward_camera(len(means)), 0.01, "distortion", opacity=0.06)
    light = lightness(image.picture()).astype(int)
    assert light[50, 75] > 150
    assert light[50, 20] < 10
    # In the range of these sheets m is 0 at one and 1 at the other, and w is at most a half for each.
    assert 0.1 < float(image.numbers().max()) <= 0.25
    top = np.percentile(image.numbers()[image.alpha.numpy() >= 0.5], 99)
    assert (light[image.numbers() > top * 1.01] > 240).all()


def test_the_distortion_range_is_taken_around_the_surfels_before_the_camera() -> None:
    camera = Camera.from_fov(10, 10, 40.0)
    means = torch.tensor([[0.0, 0.0, -3.0], [0.0, 0.0, 0.25], [0.0, 0.0, 0.5]])
    assert raster_options("distortion", means, camera).distortion_range == (0.25, 0.5)
    raster_options("distortion", means[:2], camera).check()
    raster_options("distortion", means[:1], camera).check()
    assert raster_options("depth", means, camera).outputs == "color"


def test_surfel_centres_are_drawn_where_they_project() -> None:
    points = torch.tensor([[-0.06, 0.031, 0.4], [0.05, -0.0413, 0.4], [0.0507, 0.05, 0.4]])
    for size in (101, 402):
        image = draw(points, toward_camera(3), 0.02, "surfels", size=size)
        places = Camera.from_fov(size, size, 40.0).project(points)
        assert np.allclose(image.numbers(), torch.cat([places, points[:, 2:]], -1), atol=1e-3)
        picture = image.picture()
        ground = picture[..., 0].min(where=picture[..., 3] > 0, initial=255)
        white = np.clip((picture[..., 0].astype(float) - ground) / (255.0 - ground), 0, 1)
        white[picture[..., 3] == 0] = 0
        y, x = np.mgrid[:size, :size] + 0.5
        for column, row in places.tolist():
            near = white * (np.hypot(x - column, y - row) < size / 16)
            assert abs((near * x).sum() / near.sum() - column) < 0.1
            assert abs((near * y).sum() / near.sum() - row) < 0.1
            # The disk grows with the picture: a 128th of its side is its radius.
            assert near.sum() == pytest.approx(math.pi * (size / 128) ** 2, rel=0.2)


def test_only_centres_that_can_be_seen_are_drawn() -> None:
    """Half of a ball faces away; a sheet hides most of another one; a back side is no surfel to see."""
    count = len(ball("surfels").values)
    assert 1200 < count < 2000  # of 4000: the cap that the camera sees is less than a half
    assert float(ball("surfels").values[:, 2].max()) < 0.3
    front, back = sheet(0.3, 0.05), sheet(0.4, 0.2)
    means = torch.cat([front, back])
    # A little light gets through the front sheet: what is behind it has a weight, but is not to be drawn.
    seen = draw(means, toward_camera(len(means)), 0.006, "surfels", opacity=0.3).numbers()
    assert (seen[:, 2] < 0.35).sum() == len(front)
    before = seen[(np.abs(seen[:, :2] - 50.5) < 9).all(-1)]
    assert (before[:, 2] < 0.35).all()
    assert (seen[:, 2] > 0.35).sum() > 100
    away = -toward_camera(len(back)) * torch.tensor([-1.0, 1.0, 1.0])
    assert len(draw(back, away, 0.006, "surfels").values) == 0


def test_disks_stay_apart_where_surfels_are_dense() -> None:
    dense = draw(sheet(0.4, 0.15, 40), toward_camera(1600), 0.006, "surfels", size=400)
    picture = dense.picture()
    inside = picture[150:250, 150:250].astype(int)
    assert (inside[..., 3] > 250).all()
    assert inside[..., 0].max() > 200
    assert inside[..., 0].min() < 60
    assert 0.1 < (inside[..., 0] > 128).mean() < 0.5


@pytest.mark.parametrize("name", ["", "RGB", "depths", "median"])
def test_an_unknown_channel_is_refused_with_its_code(avatar: Avatar, name: str) -> None:
    with pytest.raises(BadArgumentError) as caught:
        parse_channel(name)
    assert caught.value.code == "channel.invalid"
    with pytest.raises(BadArgumentError, match=r"channel\.invalid"):
        avatar.render("rest", "orbit:0,0", 16, 16, name)


def command(run: Path, out: Path, *more: str) -> int:
    return main(["render", str(run), "--size", "48x40", "--out", str(out), *more])


def test_the_command_line_writes_pictures_and_numbers(avatar: Avatar, run: Path, tmp_path: Path) -> None:
    for channel in CHANNELS:
        picture, numbers = tmp_path / f"{channel}.png", tmp_path / f"{channel}.npy"
        assert command(run, picture, "--pose", "fist", "--channel", channel) == 0
        assert command(run, numbers, "--pose", "fist", "--channel", channel) == 0
        wanted = avatar.view("fist", "orbit:0,0", 48, 40, channel)
        written = cv2.imread(str(picture), cv2.IMREAD_UNCHANGED)
        assert written is not None
        # Sums may run in another order in a loaded avatar: the last bit is not promised.
        levels = cv2.cvtColor(written, cv2.COLOR_BGRA2RGBA).astype(int) - wanted.picture()
        assert np.abs(levels).max() <= 3
        assert np.count_nonzero(levels) <= 0.01 * levels.size
        values = np.load(numbers)
        assert values.dtype == np.float32
        np.testing.assert_allclose(values, wanted.numbers(), atol=1e-5, rtol=1e-5)
    assert command(run, tmp_path / "default.png", "--pose", "fist") == 0
    assert (tmp_path / "default.png").read_bytes() == (tmp_path / "rgb.png").read_bytes()


def test_the_clips_frames_come_in_every_channel(avatar: Avatar, run: Path, tmp_path: Path) -> None:
    assert command(run, tmp_path / "frames", "--frames", "all", "--channel", "normal") == 0
    written = cv2.imread(str(tmp_path / "frames" / "000000.png"), cv2.IMREAD_UNCHANGED)
    assert written is not None
    wanted = avatar.image(avatar.frames.pose_of(0), avatar.camera, "normal").picture()
    assert np.array_equal(cv2.cvtColor(written, cv2.COLOR_BGRA2RGBA), wanted)


@pytest.mark.parametrize(
    ("out", "more", "code"),
    [
        ("a.png", ("--pose", "rest", "--channel", "glow"), "channel.invalid"),
        ("frames", ("--frames", "all", "--channel", "glow"), "channel.invalid"),
        ("a.npy", ("--frames", "all"), "render.out"),
        ("none/a.npy", ("--pose", "rest"), "render.out"),
        ("a.txt", ("--pose", "rest", "--channel", "depth"), "render.out"),
    ],
)
def test_bad_requests_exit_with_2_and_their_code(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], out: str, more: tuple[str, ...], code: str
) -> None:
    assert command(run, tmp_path / out, *more) == 2
    assert code in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_wrong_channel_is_told_before_the_avatar_is_read(tmp_path: Path) -> None:
    with pytest.raises(BadArgumentError, match=r"channel\.invalid"):
        render_to_file(tmp_path, "rest", "source", "8x8", tmp_path / "a.png", "glow")
    with pytest.raises(BadArgumentError, match=r"channel\.invalid"):
        render_frames(tmp_path, "all", tmp_path, "glow")


def test_the_help_names_every_channel(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["render", "--help"]) == 0
    assert "|".join(CHANNELS) in capsys.readouterr().out
