"""Cameras: projection, crops and the orbit's directions."""

from __future__ import annotations

import torch

from mass_engine.camera import Camera
from mass_engine.viewpoint import fit_source, parse_camera

SOURCE = Camera.from_fov(640, 480, 60.0)
CENTER = torch.tensor([0.05, -0.02, 0.5])


def orbit(spec: str) -> Camera:
    return parse_camera(spec, SOURCE, 512, 512, CENTER, 0.1)


def test_the_axis_point_projects_to_the_centre() -> None:
    assert torch.allclose(SOURCE.project(torch.tensor([[0.0, 0.0, 2.0]])), torch.tensor([[320.0, 240.0]]))
    # 60 degrees over 640 pixels: a point at 30 degrees lies on the edge.
    edge = SOURCE.project(torch.tensor([[0.5774, 0.0, 1.0]]))
    assert abs(float(edge[0, 0]) - 640) < 0.05


def test_crop_and_resize_move_points_as_they_move_pixels() -> None:
    point = torch.tensor([[0.1, -0.05, 0.6]])
    pixel = SOURCE.project(point)
    assert torch.allclose(SOURCE.crop(100, 50, 200, 100).project(point), pixel - torch.tensor([100.0, 50.0]))
    assert torch.allclose(SOURCE.resized(320, 240).project(point), pixel / 2)
    wide = fit_source(SOURCE, 1000, 480)
    assert torch.allclose(wide.project(point), pixel + torch.tensor([180.0, 0.0]), atol=1e-3)


def test_an_orbit_looks_at_the_centre_from_its_distance() -> None:
    for spec in ("orbit:0,0,0.4", "orbit:70,-20,0.4", "orbit:180,0,0.4"):
        camera = orbit(spec)
        assert torch.allclose(camera.project(CENTER[None]), torch.tensor([[256.0, 256.0]]), atol=1e-2)
        rotation, shift = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
        assert abs(float((-rotation.T @ shift - CENTER).norm()) - 0.4) < 1e-5
        assert torch.allclose(rotation @ rotation.T, torch.eye(3), atol=1e-5)


def test_yaw_moves_the_camera_right_and_pitch_up() -> None:
    def place(spec: str) -> torch.Tensor:
        m = orbit(spec).world_to_camera
        return -m[:3, :3].T @ m[:3, 3] - CENTER

    assert torch.allclose(place("orbit:0,0,0.4"), torch.tensor([0.0, 0.0, -0.4]), atol=1e-6)
    assert float(place("orbit:30,0,0.4")[0]) > 0.1
    assert float(place("orbit:0,30,0.4")[1]) < -0.1  # y points down


def test_without_a_distance_the_hand_fits_the_picture() -> None:
    camera = orbit("orbit:20,10")
    around = CENTER + 0.1 * torch.nn.functional.normalize(
        torch.randn(500, 3, generator=torch.manual_seed(0)), dim=-1
    )
    pixels = camera.project(around)
    assert float(pixels.min()) >= 0
    assert float(pixels.max()) <= 512
    assert float(pixels.max() - pixels.min()) > 400
