"""From pose to surfels: how long it takes, how well the surfels cover the hand, and how much they blur it.

``python benchmarks/hand_surfels.py [time|coverage]`` prints

- for the full model (two Loop levels, fractal depth 1) the milliseconds from one pose to its surfels, part by
  part, and for other sizes the totals (median and least of 60, no gradients);
- for a range of standard deviations per semi-axis, over 20 views at rest and in a fist: the share of the
  hand's pixels with alpha > 0.99, the alpha that spills over the outline (in per cent of the hand's pixels),
  and how much contrast is left of stripes 4 mm apart painted on the surfels of the resting hand.

The hand's pixels are those of the subdivided mesh itself.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import cv2
import numpy as np
import torch
from hand_contact_sheet import camera_at
from numpy.typing import NDArray
from torch import Tensor

from mass_engine.camera import Camera
from mass_engine.fitting.subject import draw
from mass_engine.hand.builtin import load_builtin
from mass_engine.hand.model import HandModel
from mass_engine.hand.pose import HandPose
from mass_engine.hand.poses import named_pose
from mass_engine.raster import RasterOptions
from mass_engine.surfel.binding import AttachedSurfels, MeshBinding
from mass_engine.surfel.inellipse import SIGMA_PER_SEMI_AXIS

_MODELS = ((1, 0), (1, 1), (2, 0), (2, 1))
_SIGMAS = (0.5, 0.7, 0.85, 1.0, 1.25, 1.5)
_SIDE, _METERS, _STRIPE = 512, 0.25, 0.004


def milliseconds(work: Callable[[], object], repeats: int = 60) -> tuple[float, float]:
    """Median and least wall time."""
    spent = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        spent.append(1e3 * (time.perf_counter() - start))
    return statistics.median(spent[5:]), min(spent)


def directions(count: int) -> list[tuple[float, float, float]]:
    """Evenly spread unit vectors (a Fibonacci sphere), without those from behind the wrist."""
    golden = torch.pi * (3 - 5**0.5)
    steps = torch.arange(2 * count)
    height = 1 - (2 * steps + 1) / (2 * count)
    radius = (1 - height**2).sqrt()
    points = torch.stack([height, radius * (golden * steps).cos(), radius * (golden * steps).sin()], 1)
    chosen = points[points[:, 0] < 0.5][:count]
    return [(float(x), float(y), float(z)) for x, y, z in chosen]


def silhouette(refined: Tensor, faces: Tensor, camera: Camera) -> NDArray[np.bool_]:
    """The mesh's own pixels [H,W]."""
    local = refined @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    pixels = (local @ camera.K.T)[:, :2] / local[:, 2:]
    # Fixed-point corners; pixel centres lie at +0.5.
    corners = ((pixels - 0.5) * 16).round().int().numpy()[faces.numpy()]
    filled = np.zeros((camera.height, camera.width), np.uint8)
    for triangle in corners:
        cv2.fillConvexPoly(filled, triangle, 1, shift=4)
    return filled > 0


def stripes(points: Tensor) -> Tensor:
    """Grey [...,3] of stripes across the hand."""
    tone = 0.5 + 0.5 * torch.sin(2 * torch.pi * points[..., 0] / _STRIPE)
    return tone.unsqueeze(-1).expand(*tone.shape, 3)


def scene(pose: HandPose, model: HandModel, binding: MeshBinding, views: int) -> list[tuple[Camera, Tensor]]:
    """Cameras around a posed hand with the hand's pixels in each."""
    vertices, _ = model(pose)
    refined = binding.subdivision.apply(vertices)
    center = (vertices.amax(0) + vertices.amin(0)) / 2
    cameras = [camera_at(direction, center, _SIDE, _METERS) for direction in directions(views)]
    faces = binding.subdivision.faces
    return [(camera, torch.from_numpy(silhouette(refined, faces, camera))) for camera in cameras]


def coverage(surfels: AttachedSurfels, cameras: list[tuple[Camera, Tensor]]) -> tuple[float, float]:
    """Opaque share of the hand's pixels, and the alpha outside per pixel of the hand."""
    opacities, colors = torch.full((len(surfels.means),), 0.99), torch.ones(len(surfels.means), 3)
    inside = opaque = 0
    spilt = 0.0
    for camera, hand in cameras:
        alpha = draw(surfels, opacities, colors, camera, RasterOptions()).alpha
        inside += int(hand.sum())
        opaque += int((alpha[hand] > 0.99).sum())
        spilt += float(alpha[~hand].sum())
    return opaque / inside, spilt / inside


def contrast(surfels: AttachedSurfels, cameras: list[tuple[Camera, Tensor]]) -> float:
    """Standard deviation of drawn stripes over that of the same stripes at each pixel's own point."""
    opacities = torch.full((len(surfels.means),), 0.99)
    drawn, exact = [], []
    for camera, hand in cameras:
        out = draw(surfels, opacities, stripes(surfels.means), camera, RasterOptions())
        well_inside = cv2.erode(hand.numpy().astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
        rows, columns = np.nonzero(well_inside & (out.alpha > 0.99).numpy())
        pixels = torch.from_numpy(np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], 1)).float()
        local = pixels @ torch.linalg.inv(camera.K).T * out.depth[rows, columns].unsqueeze(-1)
        world = (local - camera.world_to_camera[:3, 3]) @ camera.world_to_camera[:3, :3]
        drawn.append(out.rgb[rows, columns, 0])
        exact.append(stripes(world)[:, 0])
    return float(torch.cat(drawn).std() / torch.cat(exact).std())


def print_times(model: HandModel) -> None:
    """The full model part by part, then totals."""
    pose = named_pose("fist", "right")
    vertices, _ = model(pose)
    print(f"{len(model.template)} vertices, {len(model.faces)} faces, {torch.get_num_threads()} threads")
    full = MeshBinding.build(model, 2, 1)
    refined, surfels = full.subdivision.apply(vertices), full.surfels(vertices)
    parts: dict[str, Callable[[], object]] = {
        "shape, correctives, skinning": lambda: model(pose),
        "Loop subdivision": lambda: full.subdivision.apply(vertices),
        "means, tangents, normals": lambda: full.register(refined),
        "all that a render needs": lambda: full.surfels(model(pose)[0]),
        "scales and quaternions, for exports": surfels.scales_quats,
    }
    for name, work in parts.items():
        median, least = milliseconds(work)
        print(f"{full.count} surfels, {name}: median {median:.2f} ms, least {least:.2f} ms")
    for levels, depth in _MODELS[:-1]:
        binding = MeshBinding.build(model, levels, depth)

        def whole(binding: MeshBinding = binding) -> object:
            return binding.surfels(model(pose)[0])

        median, least = milliseconds(whole)
        print(
            f"{binding.count} surfels, all that a render needs: median {median:.2f} ms, least {least:.2f} ms"
        )


def print_coverage(model: HandModel, views: int) -> None:
    """Coverage, spill and contrast for every size and standard deviation."""
    poses = {name: named_pose(name, "right") for name in ("rest", "fist")}
    finest = MeshBinding.build(model, 2, 0)
    scenes = {name: scene(pose, model, finest, views) for name, pose in poses.items()}
    print("levels depth sigma | opaque rest, fist | spill rest, fist (%) | contrast")
    for levels, depth in _MODELS:
        binding = MeshBinding.build(model, levels, depth)
        for sigma in _SIGMAS:
            found = []
            for name, pose in poses.items():
                plain = binding.surfels(model(pose)[0])
                scaled = plain.tangents * (sigma / SIGMA_PER_SEMI_AXIS)
                surfels = AttachedSurfels(plain.means, scaled, plain.normals)
                found.append(coverage(surfels, scenes[name]))
                if name == "rest":
                    sharp = contrast(surfels, scenes[name][::5])
            (rest, rest_spill), (fist, fist_spill) = found
            print(
                f"{levels} {depth} {sigma:.2f} | {rest:.4f} {fist:.4f} | "
                f"{100 * rest_spill:.2f} {100 * fist_spill:.2f} | {sharp:.3f}"
            )


def main() -> None:
    """Print both tables, or one."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("time", "coverage", "both"), nargs="?", default="both")
    parser.add_argument("--views", type=int, default=20)
    arguments = parser.parse_args()
    model = load_builtin("right")
    with torch.no_grad():
        if arguments.what in ("time", "both"):
            print_times(model)
        if arguments.what in ("coverage", "both"):
            print_coverage(model, arguments.views)


if __name__ == "__main__":
    main()
