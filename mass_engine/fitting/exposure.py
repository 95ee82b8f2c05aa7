"""How the exposure and white balance of a clip drift: a gain a frame and colour channel, before any fit.

What stands still around the hand tells it best: the same places of the picture at different times. Where the
camera moves (or nothing is behind the hand) the hand's own skin does, the same places of the surface in the
poses that the fit begins with; light from one side makes a turning hand brighter and darker, too, so that
only a large drift is believed there. Places and gains come from alternating medians of logarithms. Colours of
held-out frames are never looked at: their gains lie between their neighbours' in time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from torch import Tensor

from mass_engine.camera import Camera
from mass_engine.fitting.subject import vertex_normals
from mass_engine.fitting.views import Level, View
from mass_engine.hand.model import HandModel
from mass_engine.hand.pose import HandPose

#: Code values go with light to the power of 1 / 2.2: octaves of code values, times this, are stops.
STOPS = 2.2
#: Spread (5th to 95th percentile, in stops) from which on a clip drifts. In steady light what is around the
#: hand spreads by up to 0.15, the hand's own skin by up to 0.52.
LEAST_STOPS = {"surroundings": 0.25, "hand": 0.8}
#: Pictures of this side are looked at; a cell of what is around the hand is this share of the whole picture.
SIDE, CELL = 160, 1 / 80
#: Code values between which a place counts: beyond them cameras clip.
DARKEST, BRIGHTEST = 8 / 255, 247 / 255
#: A frame needs so many places that others show, too.
LEAST_PLACES = 30
#: What places may be left over by (octaves, their median): surroundings that stand still, and skin whose
#: poses are good enough to compare its places.
STILL, ALIKE = 0.06, 0.1
#: The hand has to follow its surroundings' drift by this much, else only the surroundings have changed.
FOLLOWS = 0.25
#: Pixels between the hand's mask and its surroundings: shadows and blur.
MARGIN = 5
ROUNDS = 12


@dataclass(frozen=True)
class Drift:
    """``gains`` [F,3] by which each frame's colours are brighter than the median frame's; ``stops`` of spread
    between the frames, ``seen_in`` "surroundings", "hand" or "nothing"."""

    gains: Tensor
    stops: float
    seen_in: str

    @property
    def certain(self) -> bool:
        """Whether the frames disagree by more than they do in steady light."""
        return self.seen_in != "nothing" and self.stops >= LEAST_STOPS[self.seen_in]


def find_drift(views: Sequence[View], start: HandPose, model: HandModel, camera: Camera) -> Drift:
    """The drift over ``views`` (in time order) with rough poses ``start`` [F] before the whole ``camera``."""
    known = [row for row, view in enumerate(views) if not view.heldout]
    levels = [views[row].level(SIDE) for row in known]
    around, leftover = _solve(torch.stack([_surroundings(level, camera) for level in levels]))
    if leftover < STILL and _mostly(around):
        drift = _drift(views, known, around, "surroundings")
        unlike = drift.certain and not _followed(levels, around)
        return Drift(torch.ones(len(views), 3), 0.0, "nothing") if unlike else drift
    with torch.no_grad():
        vertices = model.posed(start.rows(torch.tensor(known))).vertices
    skin = [_skin(level, mesh, model.faces) for level, mesh in zip(levels, vertices, strict=True)]
    found, leftover = _solve(torch.stack(skin))
    if leftover >= ALIKE or not _mostly(found):
        return Drift(torch.ones(len(views), 3), 0.0, "nothing")
    return _drift(views, known, found, "hand")


def between(logs: Tensor, views: Sequence[View], known: Sequence[int]) -> Tensor:
    """Rows [F,3] of all ``views`` from those of the ``known`` rows [K,3], linear in time between them."""
    times = np.array([view.time for view in views])
    unit = np.eye(len(known))
    shares = np.stack([np.interp(times, times[list(known)], column) for column in unit], -1)
    shares[list(known)] = unit  # whatever their times
    return torch.from_numpy(shares).to(logs) @ logs


def without(level: Level, gain: Tensor) -> Level:
    """The level as a frame without its ``gain`` [3] would have shown it."""
    return replace(level, rgb=level.rgb / gain)


def _drift(views: Sequence[View], known: list[int], logs: Tensor, seen_in: str) -> Drift:
    """Octaves [K,3] of the ``known`` rows, NaN where a frame showed too little, to gains of all."""
    shown = [place for place in range(len(known)) if bool(logs[place].isfinite().all())]
    logs = logs[shown] - logs[shown].median(0).values
    filled = between(logs, views, [known[place] for place in shown])
    return Drift((filled * np.log(2.0)).exp(), _spread(logs), seen_in)


def _mostly(logs: Tensor) -> bool:
    """Whether most frames showed enough."""
    return 2 * int(logs.isfinite().all(-1).sum()) > max(2, len(logs))


def _spread(logs: Tensor) -> float:
    """Stops between the 5th and the 95th percentile, of the channel that differs most."""
    logs = logs[logs.isfinite().all(-1)]
    if len(logs) < 2:
        return 0.0
    return STOPS * float((logs.quantile(0.95, 0) - logs.quantile(0.05, 0)).max())


def _solve(logs: Tensor) -> tuple[Tensor, float]:
    """Octaves [K,3] by which frames differ and the median leftover of a place, from those of places [K,P,3]
    (NaN: not seen). Frames with fewer than LEAST_PLACES that others show are NaN."""
    shared = logs.isfinite().all(-1)
    shared &= shared.sum(0) >= 2
    logs = torch.where(shared.unsqueeze(-1), logs, torch.nan)
    logs[shared.sum(1) < LEAST_PLACES] = torch.nan
    gains = torch.zeros(len(logs), 3)
    for _ in range(ROUNDS):
        places = (logs - gains.unsqueeze(1)).nanmedian(0).values
        gains = (logs - places).nanmedian(1).values
        gains = gains - gains.nanmedian(0).values
        gains = torch.where(gains.isfinite(), gains, 0.0)
    left = (logs - places - gains.unsqueeze(1)).abs()
    gains[~shared.any(1) | (shared.sum(1) < LEAST_PLACES)] = torch.nan
    leftover = float(left.nanmedian())
    return gains, leftover if leftover == leftover else float("inf")


def _surroundings(level: Level, camera: Camera) -> Tensor:
    """Octaves of the background's mean colour in each cell of the whole picture [P,3], NaN where it does not
    show enough."""
    size = max(camera.width, camera.height) * CELL
    wide, high = int(camera.width / size) + 1, int(camera.height / size) + 1
    # Places of the crop's pixels in the whole picture.
    scale = (camera.K.diagonal() / level.camera.K.diagonal())[:2].tolist()
    middle, whole = level.camera.K[:2, 2].tolist(), camera.K[:2, 2].tolist()
    x = (torch.arange(level.hand.shape[1]) + 0.5 - middle[0]) * scale[0] + whole[0]
    y = (torch.arange(level.hand.shape[0]) + 0.5 - middle[1]) * scale[1] + whole[1]
    column, line = (x / size).long().clamp(0, wide - 1), (y / size).long().clamp(0, high - 1)
    cell = (line.unsqueeze(1) * wide + column).flatten()
    taken = ((level.hand > 0) | (level.valid == 0)).numpy().astype(np.uint8)
    taken = np.asarray(cv2.dilate(taken, np.ones((2 * MARGIN + 1, 2 * MARGIN + 1), np.uint8)))
    free = torch.from_numpy(taken == 0) & _exposed(level.rgb)
    share = torch.zeros(wide * high).index_add(0, cell, free.float().flatten())
    color = torch.zeros(wide * high, 3).index_add(0, cell, (level.rgb * free.unsqueeze(-1)).flatten(0, 1))
    full = size**2 / (scale[0] * scale[1])
    return torch.where((share > 0.8 * full).unsqueeze(-1), (color / share.unsqueeze(-1)).log2(), torch.nan)


def _skin(level: Level, vertices: Tensor, faces: Tensor) -> Tensor:
    """Octaves of the colours where ``vertices`` [V,3] that face the camera are [V,3], NaN elsewhere."""
    toward = -(vertex_normals(vertices, faces) * torch.nn.functional.normalize(vertices, dim=-1)).sum(-1)
    height, width = level.hand.shape
    x, y = level.camera.project(vertices).floor().long().unbind(-1)
    inside = (toward > 0.5) & (x >= 0) & (y >= 0) & (x < width) & (y < height)
    x, y = x.clamp(0, width - 1), y.clamp(0, height - 1)
    usable = (level.hand > 0.95) & (level.colored > 0.5) & _exposed(level.rgb)
    smooth = torch.from_numpy(np.asarray(cv2.blur(level.rgb.numpy(), (3, 3)), np.float32))
    seen = (inside & usable[y, x]).unsqueeze(-1)
    return torch.where(seen, smooth[y, x].clamp_min(DARKEST).log2(), torch.nan)


def _exposed(rgb: Tensor) -> Tensor:
    """Pixels in which no channel is clipped."""
    return (rgb.amin(-1) > DARKEST) & (rgb.amax(-1) < BRIGHTEST)


def _followed(levels: Sequence[Level], logs: Tensor) -> bool:
    """Whether the hand gets brighter and darker with what is around it."""
    means = []
    for level in levels:
        hand = (level.hand > 0.95) & (level.colored > 0.5)
        means.append(level.rgb[hand].clamp_min(DARKEST).log2().nanmedian(0).values)
    pairs = torch.stack([torch.stack(means), logs])
    pairs = pairs[:, pairs.isfinite().all(-1).all(0)]
    hand, around = pairs - pairs.mean(1, keepdim=True)
    return len(around) > 1 and bool((hand * around).sum() >= FOLLOWS * around.square().sum())
