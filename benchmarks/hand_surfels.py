"""From pose to surfels: how long it takes, and how well the surfels cover the hand.

``python benchmarks/hand_surfels.py`` prints, for several levels of Loop subdivision and fractal depths, the
median milliseconds of skinning and of the surfels (no gradients), and the fraction of the hand's pixels with
alpha > 0.99 over 20 views, at rest and in a fist, for a range of standard deviations per semi-axis.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import torch
from hand_contact_sheet import camera_at
from torch import Tensor

from mass_engine.fitting.subject import draw
from mass_engine.hand.builtin import load_builtin
from mass_engine.hand.poses import named_pose
from mass_engine.raster import RasterOptions
from mass_engine.surfel.binding import AttachedSurfels, MeshBinding
from mass_engine.surfel.inellipse import SIGMA_PER_SEMI_AXIS

_MODELS = ((1, 0), (1, 1), (2, 0), (2, 1))


def milliseconds(work: Callable[[], object], repeats: int = 40) -> float:
    """Median wall time."""
    spent = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        spent.append(time.perf_counter() - start)
    return 1e3 * statistics.median(spent[5:])


def directions(count: int) -> list[tuple[float, float, float]]:
    """Evenly spread unit vectors (a Fibonacci sphere), without those from behind the wrist."""
    golden = torch.pi * (3 - 5**0.5)
    steps = torch.arange(2 * count)
    height = 1 - (2 * steps + 1) / (2 * count)
    radius = (1 - height**2).sqrt()
    points = torch.stack([height, radius * (golden * steps).cos(), radius * (golden * steps).sin()], 1)
    chosen = points[points[:, 0] < 0.5][:count]
    return [(float(x), float(y), float(z)) for x, y, z in chosen]


def coverage(surfels: AttachedSurfels, factor: float, vertices: Tensor, views: int, side: int = 512) -> float:
    """Fraction of the pixels inside the silhouette's half-alpha line that are opaque (alpha > 0.99)."""
    scaled = AttachedSurfels(surfels.means, surfels.tangents * factor, surfels.normals)
    opacities = torch.full((len(surfels.means),), 0.99)
    colors = torch.ones(len(surfels.means), 3)
    center = (vertices.amax(0) + vertices.amin(0)) / 2
    inside = opaque = 0
    for direction in directions(views):
        out = draw(scaled, opacities, colors, camera_at(direction, center, side, 0.25), RasterOptions())
        inside += int((out.alpha > 0.5).sum())
        opaque += int((out.alpha > 0.99).sum())
    return opaque / inside


def main() -> None:
    """Print both tables."""
    model = load_builtin("right")
    poses = {name: named_pose(name, "right") for name in ("rest", "fist")}
    with torch.no_grad():
        posed = {name: model(pose)[0] for name, pose in poses.items()}
        print(f"{len(model.template)} vertices, {len(model.faces)} faces, {torch.get_num_threads()} threads")
        print(f"skinning {milliseconds(lambda: model(poses['fist'])):.2f} ms")
        for levels, depth in _MODELS:
            binding = MeshBinding.build(model, levels, depth)
            surfels = binding.surfels(posed["fist"])
            both = milliseconds(lambda b=binding: b.surfels(posed["fist"]))  # type: ignore[misc]
            axes = milliseconds(surfels.scales_quats)
            refine = milliseconds(lambda b=binding: b.subdivision.apply(posed["fist"]))  # type: ignore[misc]
            print(
                f"levels {levels} depth {depth}: {binding.count:7d} surfels, {both:.2f} ms "
                f"(of which subdivision {refine:.2f}), scales and quats {axes:.2f} ms more"
            )
        for levels, depth in _MODELS:
            binding = MeshBinding.build(model, levels, depth)
            for sigma in (0.5, 0.7, 0.85, 1.0, 1.25):
                shares = [
                    coverage(binding.surfels(vertices), sigma / SIGMA_PER_SEMI_AXIS, vertices, 20)
                    for vertices in posed.values()
                ]
                named = ", ".join(f"{name} {share:.4f}" for name, share in zip(posed, shares, strict=True))
                print(f"levels {levels} depth {depth} sigma {sigma:.2f} semi-axis: opaque share {named}")


if __name__ == "__main__":
    main()
