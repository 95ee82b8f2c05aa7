"""Draw what the conventions of other 2DGS renderers change: one sheet per difference, and figures for a hand.

    python benchmarks/renderer_conventions.py --out docs/images

Each sheet shows the same surfels as "exact", "inria" and "gsplat" render them.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mass_engine.camera import Camera
from mass_engine.evaluation.raster_scene import Scene, hand_camera, hand_scene
from mass_engine.raster import RasterOptions, RenderOutput, rasterize
from mass_engine.raster.types import Convention
from mass_engine.surfel.inellipse import principal_tangents

CONVENTIONS: tuple[Convention, ...] = get_args(Convention)
Picture = NDArray[np.uint8]


def disks(means: list[list[float]], scales: list[list[float]], tilts: list[float], opacity: float) -> Scene:
    """White disks turned about the vertical by ``tilts`` (radians)."""
    count, half = len(means), torch.tensor(tilts) / 2
    quats = torch.stack([half.cos(), torch.zeros(count), half.sin(), torch.zeros(count)], -1)
    tangents = principal_tangents(torch.tensor(scales), quats)
    return Scene(torch.tensor(means), tangents, torch.full((count,), opacity), torch.ones(count, 3))


def renders(scene: Scene, camera: Camera) -> dict[Convention, RenderOutput]:
    return {c: rasterize(*scene.tensors(), camera, options=RasterOptions(convention=c)) for c in CONVENTIONS}


def enlarged(values: Tensor, zoom: int, tiles: bool) -> Picture:
    """Values in 0..1 as colours, every pixel ``zoom`` wide, with the borders of 16-pixel tiles."""
    levels = (values.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    picture = cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS)
    picture = cv2.resize(picture, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_NEAREST)
    if tiles:
        for edge in range(0, picture.shape[0], 16 * zoom):
            picture[edge : edge + 1] = picture[:, edge : edge + 1] = 255
    return picture.astype(np.uint8)


def sheet(pictures: dict[Convention, Picture], path: Path) -> None:
    """The conventions side by side, each under its name."""
    columns = []
    for name, picture in pictures.items():
        title = np.full((28, picture.shape[1], 3), 255, np.uint8)
        cv2.putText(title, name, (6, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (0, 0, 0), 1, cv2.LINE_AA)
        framed = cv2.vconcat([title, picture])
        columns.append(cv2.copyMakeBorder(framed, 0, 0, 0, 8, cv2.BORDER_CONSTANT, value=(255, 255, 255)))
    cv2.imwrite(str(path), cv2.hconcat(columns))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for the pictures")
    out: Path = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)

    # Alpha stretched forty-fold: what matters is where it ends.
    wide = disks([[0.055, 0.055, 1.0]], [[0.25, 0.25]], [0.0], 1.0)
    camera = Camera.from_fov(160, 160, 90.0)
    sheet(
        {c: enlarged(r.alpha * 40, 2, True) for c, r in renders(wide, camera).items()},
        out / "bounds.png",
    )
    pixels = ((1, 6), (15, 15), (17, 24), (9, 17))
    specks = [[(x + 0.5) / 32 - 0.5, (y + 0.5) / 32 - 0.5, 1.0] for x, y in pixels]
    points = disks(specks, [[1e-5, 1e-5]] * 4, [0.0] * 4, 1.0)
    small = Camera.from_fov(32, 32, 2 * 26.565051)
    sheet(
        {c: enlarged(r.alpha * 10, 10, True) for c, r in renders(points, small).items()},
        out / "low_pass.png",
    )
    tilted = disks([[-0.4, 0.0, 1.0], [0.4, 0.0, 1.0]], [[0.25, 0.25]] * 2, [0.8, -0.8], 0.99)
    shown = renders(tilted, camera)
    depths = {c: (r.depth - 0.6) * (r.alpha > 0.1).float() / 0.8 for c, r in shown.items()}
    sheet({c: enlarged(depth, 2, False) for c, depth in depths.items()}, out / "depth.png")
    near = disks([[0.0, 0.0, 0.15], [0.3, 0.0, 1.0]], [[0.02, 0.02], [0.1, 0.1]], [0.0, 0.0], 0.99)
    sheet({c: enlarged(r.alpha, 2, False) for c, r in renders(near, camera).items()}, out / "near.png")

    print("| surfels | convention | largest colour difference | pixels off by 1/255 | depth, mm, p99 |")
    print("|---|---|---|---|---|")
    for count in (12_304, 196_864):
        scene = hand_scene(count)
        by_convention = renders(scene, hand_camera(scene, 512, 334))
        exact = by_convention["exact"]
        covered = exact.alpha > 0.5
        for name in CONVENTIONS[1:]:
            other = by_convention[name]
            color = (other.rgb - exact.rgb).abs().amax(-1)
            depth = (other.depth - exact.depth).abs()[covered] * 1000
            off = float((color > 1 / 255).float().mean())
            far = float(depth.quantile(0.99))
            print(f"| {count} | {name} | {float(color.max()):.4f} | {off:.2%} | {far:.3f} |")


if __name__ == "__main__":
    main()
