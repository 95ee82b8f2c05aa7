"""Scores of rendered frames against the video, each with its convention in its name."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import torch
from torch import Tensor

from mass_engine.avatar import Avatar, SourceFrames
from mass_engine.camera import Camera
from mass_engine.evaluation import metrics
from mass_engine.evaluation.flip import flip
from mass_engine.evaluation.lpips import LpipsSet
from mass_engine.evaluation.outlines import boundary_f, iou
from mass_engine.fitting.views import View
from mass_engine.hand.pose import HandPose
from mass_engine.raster import RenderOutput

#: How far apart two outlines may be to count as one in ``boundary_f_2px``, pixels.
BOUNDARY_REACH = 2.0

Scores = dict[str, float]


class Renderable(Protocol):
    """What is scored: an avatar or a baseline. ``camera`` is that of the whole picture."""

    @property
    def camera(self) -> Camera:
        """The camera of the whole picture."""
        ...

    def render_pose(self, pose: HandPose, camera: Camera) -> RenderOutput:
        """One pose (a batch of one) over black."""
        ...


@dataclass(frozen=True)
class Exposed:
    """A ``subject`` as a frame shows it whose colours are brighter by ``gain`` [3]."""

    subject: Renderable
    gain: Tensor

    @property
    def camera(self) -> Camera:
        """The camera of the whole picture."""
        return self.subject.camera

    def render_pose(self, pose: HandPose, camera: Camera) -> RenderOutput:
        """One pose (a batch of one) over black."""
        out = self.subject.render_pose(pose, camera)
        return replace(out, rgb=out.rgb * self.gain)


#: What is scored: what renders, the view it is held against, and the pose in it (a batch of one).
Frame = tuple[Renderable, View, HandPose]


def frames_of(avatar: Avatar, views: Sequence[View]) -> list[Frame]:
    """The avatar in every view's own pose and exposure."""
    return placed(avatar, avatar.frames, views)


def placed(subject: Renderable, frames: SourceFrames, views: Sequence[View]) -> list[Frame]:
    """The ``subject`` in the pose and under the gain that ``frames`` have for every view."""
    return [
        (Exposed(subject, frames.gain_of(view.index)), view, frames.pose_of(view.index)) for view in views
    ]


@dataclass(frozen=True)
class Comparison:
    """One frame and its render, at the size the fit sees the frame.

    ``render`` and ``video`` [h,w,3] are the crop's (the render over black, float), ``alpha``, ``hand`` and
    ``valid`` [h,w] (bools) too; :meth:`on_black` are the whole pictures.
    """

    render: Tensor
    video: Tensor
    alpha: Tensor
    hand: Tensor
    valid: Tensor
    corner: tuple[int, int]  # row and column of the crop in the whole picture
    size: tuple[int, int]  # height and width of that

    @staticmethod
    def of(subject: Renderable, view: View, pose: HandPose) -> Comparison:
        """Render ``pose`` through the camera of ``view``."""
        level = view.level(1 << 16)
        out = subject.render_pose(pose, level.camera)
        whole = subject.camera
        scale = float(view.camera.K[0, 0] / whole.K[0, 0])  # large crops are reduced
        x, y = (max(0, round(float(whole.K[k, 2] * scale - view.camera.K[k, 2]))) for k in (0, 1))
        height = max(round(whole.height * scale), y + level.camera.height)
        width = max(round(whole.width * scale), x + level.camera.width)
        return Comparison(
            out.rgb,
            level.rgb,
            out.alpha,
            level.hand > 0.5,
            level.valid > 0.5,
            (y, x),
            (height, width),
        )

    def on_black(self, render: Tensor) -> tuple[Tensor, Tensor]:
        """``render`` and the masked video on black pictures; ignored pixels (forearm) are black in both."""
        picture, truth = torch.zeros(2, *self.size, 3)
        y, x = self.corner
        window = slice(y, y + self.hand.shape[0]), slice(x, x + self.hand.shape[1])
        picture[window] = render * self.valid.unsqueeze(-1)
        truth[window] = self.video * self.hand.unsqueeze(-1)
        return picture, truth


def score_view(subject: Renderable, view: View, pose: HandPose) -> Scores:
    """The scores report.json holds, on 8-bit values.

    ``psnr_in_mask`` compares the render over black with the video inside the hand mask. The figures
    ``*_hand_on_black`` compare it with the masked video over the whole picture; ignored pixels (forearm)
    are black in both. SSIM is without padding. ``silhouette_iou`` leaves ignored pixels out.
    """
    return _plain(Comparison.of(subject, view, pose))


def score_view_fully(
    subject: Renderable, view: View, pose: HandPose, lpips: LpipsSet | None = None
) -> dict[str, float | None]:
    """:func:`score_view` and every other convention; None is not computed.

    ``*_float`` without rounding to 8 bits; ``ssim_zero_padded_*`` with zeros around the picture; FLIP at its
    authors' default distance; ``lpips_*`` see :data:`mass_engine.evaluation.lpips.CONVENTIONS`;
    ``boundary_f_2px`` of the outlines.
    """
    found = Comparison.of(subject, view, pose)
    picture, truth = found.on_black(metrics.to_8bit(found.render))
    exact, _ = found.on_black(found.render.clamp(0, 1))
    clamped = found.render.clamp(0, 1)
    scores: dict[str, float | None] = dict(_plain(found))
    scores["psnr_in_mask_float"] = (
        metrics.psnr(clamped, found.video, found.hand) if bool(found.hand.any()) else math.nan
    )
    scores["psnr_hand_on_black_float"] = metrics.psnr(exact, truth)
    scores["ssim_zero_padded_hand_on_black"] = metrics.ssim_zero_padded(picture, truth)
    scores["flip_hand_on_black"] = flip(picture, truth)
    for name, value in (lpips or LpipsSet({})).scores(picture, truth).items():
        scores[f"{name}_hand_on_black"] = value
    scores["boundary_f_2px"] = boundary_f(found.alpha > 0.5, found.hand, BOUNDARY_REACH, found.valid)
    return scores


def _plain(found: Comparison) -> Scores:
    render = metrics.to_8bit(found.render)
    picture, truth = found.on_black(render)
    return {
        "psnr_in_mask": metrics.psnr(render, found.video, found.hand) if bool(found.hand.any()) else math.nan,
        "psnr_hand_on_black": metrics.psnr(picture, truth),
        "ssim_hand_on_black": metrics.ssim_valid(picture, truth),
        "ms_ssim_hand_on_black": metrics.ms_ssim(picture, truth),
        "silhouette_iou": iou(found.alpha > 0.5, found.hand, found.valid),
    }


def mean_scores(rows: Sequence[dict[str, Any]]) -> dict[str, float | None]:
    """Means over frames; None where no frame has a finite value."""
    result: dict[str, float | None] = {}
    for name in [key for key in (rows[0] if rows else {}) if key not in ("index", "time")]:
        given = [float(row[name]) for row in rows if row[name] is not None]
        values = [value for value in given if math.isfinite(value)]
        result[name] = sum(values) / len(values) if values else None
    return result


def heldout_means(avatar: Avatar, views: Sequence[View]) -> dict[str, float | None]:
    """Means of :func:`score_view` over the held-out ``views``."""
    held = [view for view in views if view.heldout]
    return mean_scores([score_view(*frame) for frame in frames_of(avatar, held)])
