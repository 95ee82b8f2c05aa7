"""Scores of rendered frames against the video: what report.json holds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from mass_engine.avatar import Avatar
from mass_engine.evaluation import metrics
from mass_engine.fitting.views import View
from mass_engine.hand.pose import HandPose


def score_view(avatar: Avatar, view: View, pose: HandPose, gain: Tensor | None = None) -> dict[str, float]:
    """Scores of one frame, on 8-bit values, inside the view's crop placed on a black picture.

    ``psnr_in_mask`` compares the render over black with the video inside the hand mask. The figures
    ``*_hand_on_black`` compare it with the masked video over the whole picture; ignored pixels (forearm)
    are black in both. ``silhouette_iou`` leaves ignored pixels out. ``gain`` [3] is the frame's exposure.
    """
    level = view.level(1 << 16)
    out = avatar.render_pose(pose, level.camera)
    hand, valid = level.hand > 0.5, level.valid > 0.5
    render = metrics.to_8bit(out.rgb if gain is None else out.rgb * gain)
    x = round(float(avatar.camera.K[0, 2] - view.camera.K[0, 2]))
    y = round(float(avatar.camera.K[1, 2] - view.camera.K[1, 2]))
    picture, truth = torch.zeros(2, avatar.camera.height, avatar.camera.width, 3)
    window = slice(y, y + level.camera.height), slice(x, x + level.camera.width)
    picture[window] = render * valid.unsqueeze(-1)
    truth[window] = level.rgb * hand.unsqueeze(-1)
    return {
        "psnr_in_mask": metrics.psnr(render, level.rgb, hand) if bool(hand.any()) else math.nan,
        "psnr_hand_on_black": metrics.psnr(picture, truth),
        "ssim_hand_on_black": metrics.ssim_valid(picture, truth),
        "ms_ssim_hand_on_black": metrics.ms_ssim(picture, truth),
        "silhouette_iou": metrics.iou(out.alpha > 0.5, hand, valid),
    }


def mean_scores(rows: Sequence[dict[str, Any]]) -> dict[str, float | None]:
    """Means over frames; None where no frame has a finite value."""
    result: dict[str, float | None] = {}
    for name in [key for key in (rows[0] if rows else {}) if key not in ("index", "time")]:
        values = [float(row[name]) for row in rows if math.isfinite(float(row[name]))]
        result[name] = sum(values) / len(values) if values else None
    return result
