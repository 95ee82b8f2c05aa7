"""Contact sheet of what the fit starts from: the mask and the aligned, refined mesh over the video.

``python benchmarks/preprocessing_sheet.py VIDEO --out SHEET.png [--count 24]``. Green: the mask's outline;
blue tint: ignored; magenta: the outline of the mesh.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from preprocessing_truth import refine

from mass_engine.avatar import row_pose
from mass_engine.fitting.subject import Shape, draw, pose_surfels
from mass_engine.fitting.views import View
from mass_engine.hand.pose import HandPose
from mass_engine.options import FitOptions
from mass_engine.preprocess import prepare
from mass_engine.progress import ProgressMeter
from mass_engine.raster import RasterOptions
from mass_engine.surfel.binding import MeshBinding
from mass_engine.tracking.segmentation import HAND, IGNORE

_CELL = 260


def outline(picture: NDArray[np.uint8], inside: NDArray[np.bool_], color: tuple[int, int, int]) -> None:
    """Draw the border of ``inside`` [H,W] into a BGR picture."""
    contours, _ = cv2.findContours(inside.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(picture, contours, -1, color, 1, cv2.LINE_AA)


def cell(view: View, shape: Shape, binding: MeshBinding, pose: HandPose) -> NDArray[np.uint8]:
    """One frame of the sheet."""
    with torch.no_grad():
        surfels = pose_surfels(shape, binding, pose).row(0)
        count, options = binding.count, RasterOptions(cull_backfaces=True)
        out = draw(surfels, torch.full((count,), 0.99), torch.ones(count, 3), view.camera, options)
    picture = view.rgb[..., ::-1].copy()
    ignored = view.labels == IGNORE
    picture[ignored] = picture[ignored] // 2 + np.array([100, 30, 0], np.uint8)
    outline(picture, view.labels == HAND, (0, 255, 0))
    outline(picture, out.alpha.numpy() > 0.5, (255, 0, 255))
    scale = _CELL / max(picture.shape[:2])
    size = (max(1, round(picture.shape[1] * scale)), max(1, round(picture.shape[0] * scale)))
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    made = np.zeros((_CELL, _CELL, 3), np.uint8)
    made[: size[1], : size[0]] = small
    cv2.putText(
        made, str(view.index), (4, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA
    )
    return made


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("video", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--count", type=int, default=24)
    arguments = parser.parse_args()
    meter = ProgressMeter(lambda *_: None)
    clip = prepare(arguments.video, FitOptions(), meter, lambda code, text, _: print(f"{code}: {text}"))
    print(
        f"{clip.tracked} of {clip.frames_read} frames tracked, side {clip.model.side}, "
        f"not trusted: {clip.doubted}"
    )
    shape, pose = refine(clip, clip.start)
    pose = replace(pose, betas=shape.betas.expand_as(pose.betas))
    binding = MeshBinding.build(clip.model, 1, 1)
    rows = np.unique(np.linspace(0, len(clip.views) - 1, arguments.count).round().astype(int))
    cells = [cell(clip.views[row], shape, binding, row_pose(pose, int(row))) for row in rows]
    columns = 6
    while len(cells) % columns:
        cells.append(np.zeros_like(cells[0]))
    sheet = cv2.vconcat([cv2.hconcat(cells[i : i + columns]) for i in range(0, len(cells), columns)])
    cv2.imwrite(str(arguments.out), sheet)


if __name__ == "__main__":
    main()
