"""Held-out frames of a clip beside their renders and the error.

``python benchmarks/heldout_sheet.py VIDEO OUT.png``

Fits VIDEO with every 8th frame held out, prints the mean scores (and of ``--refined-frames`` those after
test-time pose refinement) and draws up to eight of these frames as fitted: video, render over black,
absolute error in the mask (times four), and the two silhouettes (green: mask alone; red: render alone; blue:
ignored).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mass_engine.avatar import Avatar, row_pose
from mass_engine.evaluation.arguments import add_refined_frames
from mass_engine.fitting.views import View
from mass_engine.options import FitOptions
from mass_engine.pipeline import fit

ROW_WIDTH = 1280


def main() -> None:
    """Fit, print, draw."""
    parser = argparse.ArgumentParser()
    parser.add_argument("video", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--preset", default="auto")
    add_refined_frames(parser, 4)
    arguments = parser.parse_args()
    options = FitOptions(holdout=8, preset=arguments.preset, refined_frames=arguments.refined_frames)
    outcome = fit(arguments.video, options)
    print(outcome.report.summary())
    rows = [row for row, view in enumerate(outcome.clip.views) if view.heldout]
    shown = [rows[place] for place in np.linspace(0, len(rows) - 1, min(8, len(rows))).round().astype(int)]
    pictures = [_draw(outcome.avatar, outcome.clip.views[row], row) for row in shown]
    cv2.imwrite(str(arguments.out), np.concatenate(pictures)[..., ::-1])


def _draw(avatar: Avatar, view: View, row: int) -> NDArray[np.uint8]:
    level = view.level(1 << 16)
    out = avatar.render_pose(row_pose(avatar.frames.pose, row), level.camera)
    rgb, render = level.rgb.numpy(), out.rgb.clamp(0, 1).numpy()
    hand, drawn = level.hand.numpy() > 0.5, out.alpha.numpy() > 0.5
    error = np.clip(np.abs(render - rgb).mean(-1) * hand * 4, 0, 1)
    heat = cv2.applyColorMap((error * 255).astype(np.uint8), cv2.COLORMAP_MAGMA)[..., ::-1] / 255
    outlines = np.stack([drawn, hand, level.valid.numpy() < 0.5], -1) * 0.6
    strip = (np.concatenate([rgb, render, heat, outlines], 1) * 255).astype(np.uint8)
    height = round(ROW_WIDTH * strip.shape[0] / strip.shape[1])
    return np.asarray(cv2.resize(strip, (ROW_WIDTH, height), interpolation=cv2.INTER_AREA), np.uint8)


if __name__ == "__main__":
    main()
