"""Masks that leave out part of the hand: where something lies before it, or the segmenter erred.

A mask calls background what covers the hand. Taken at its word it bends fingers out of the way and makes skin
transparent. Where the rendered hand says hand, the mask says background, and most other frames call the same
skin hand, nothing is known: such regions are ignored from there on. They are found anew, from the masks as
they were given, whenever poses have moved on; what is narrow may be a pose's fault and stays.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mass_engine.camera import Camera
from mass_engine.fitting.evidence import Scene, gather, spread
from mass_engine.fitting.skin import Skin
from mass_engine.fitting.state import FitState
from mass_engine.fitting.subject import START_OPACITY, draw
from mass_engine.fitting.views import Level, View
from mass_engine.surfel.binding import MeshBinding
from mass_engine.surfel.shading import white_light
from mass_engine.tracking.alignment import hand_size_pixels
from mass_engine.tracking.offsets import tracked_points
from mass_engine.tracking.segmentation import BACKGROUND, HAND, IGNORE

#: Longer side of the pictures that masks and renders are compared in, pixels.
SIDE = 320
#: Frames that are asked what is hand, and the longer side of their pictures.
ASKED, ASKED_SIDE = 60, 160
#: Skin of which at least this share of what the frames show is hand belongs to the hand.
CONSENSUS = 0.6
#: Radius of the disc that must fit into a covered region, hand sizes, by the step it is looked for before:
#: as large as poses may still be wrong.
LOOKS = {
    "stage 1, 96 px": 0.035,
    "stage 1, outline": 0.025,
    "stage 1, sweep": 0.018,
    "stage 1, texture 1": 0.018,
    "conversion": 0.016,
}
#: How much wider a region must be that reaches the render's outline.
AT_RIM = 1.25
#: Least radius of the disc, pixels of ``SIDE``.
LEAST_RADIUS = 2.5
#: Joints farther than this from their landmarks are astray, hand sizes.
ASTRAY = 0.05
#: What of a hand a joint takes along, hand sizes squared: a finger's width by the length of a segment.
SEGMENT = 0.011
#: Bare hand counts from so many radii of thickness, up to so many radii from a region at the rim, and from
#: this share of the region's pixels.
BARE, BESIDE, BARE_SHARE = 0.4, 4.0, 0.3
#: A frame of whose hand more than this share is bare is misplaced altogether, and says nothing.
MISPLACED = 0.08
#: How far beyond a covered region nothing is known either, hand sizes.
MARGIN = 0.015

Bind = Callable[[int, int, bool], MeshBinding]
Mask = NDArray[np.bool_]
Points = NDArray[np.float32]


def covered_pixels(
    level: Level, drawn: Mask, known: Mask, astray: Points, radius: float, size: float
) -> Mask:
    """What of a frame's background is hand that something covers, and a margin around it [h,w].

    ``drawn`` [h,w]: the rendered hand; ``known``: where it is skin that the frames agree on; ``astray``
    [P,2]: pixels of joints that are not where the landmarks are. A disc of ``radius`` pixels must fit into a
    region: gaps between fingers, and what a pose misses, are narrower. ``size`` of the hand in pixels.
    """
    hand = level.hand.numpy() > 0.5
    background = ~hand & (level.valid.numpy() > 0.5)
    missing = drawn & known & background
    # Opened by the disc: without the slivers along outlines that hang on.
    region = _opened(missing, radius)
    # Hand that the render leaves bare right beside a region: the finger is not covered, it is misplaced. So
    # it is where a region at the render's outline is narrow, or no larger than joints that should be
    # elsewhere explain.
    bare = _opened(hand & ~drawn, BARE * radius)
    if bare.sum() > MISPLACED * hand.sum():
        return np.zeros_like(hand)
    count, parts = cv2.connectedComponents(region.astype(np.uint8), connectivity=8)
    for part in range(1, count):
        own = parts == part
        near = _distance(own)
        at_rim = _distance(~drawn)[own].min() <= radius
        beside = bare & (near <= (BESIDE * radius if at_rim else radius))
        elsewhere = beside.sum() > BARE_SHARE * own.sum()
        if at_rim and not elsewhere:
            narrow = not _opened(own, AT_RIM * radius).any()
            joints = _touching(near, astray, radius + MARGIN * size)
            elsewhere = narrow or own.sum() < joints * SEGMENT * size**2
        if elsewhere:
            region &= ~own
    return _within(region, MARGIN * size) & background


def _opened(mask: Mask, radius: float) -> Mask:
    """What of ``mask`` a disc of ``radius`` pixels inside it covers."""
    inner = np.asarray(cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5)) > radius
    return _within(inner, radius + 0.5) & mask


def _within(mask: Mask, distance: float) -> Mask:
    """Pixels at most ``distance`` from those of ``mask``."""
    return _distance(mask) <= distance if mask.any() else mask


def _distance(mask: Mask) -> NDArray[np.float32]:
    """Pixels from each pixel to the nearest of ``mask``."""
    return np.asarray(cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5), np.float32)


def _touching(distances: NDArray[np.float32], points: Points, reach: float) -> int:
    height, width = distances.shape
    columns, rows = np.floor(points).astype(int).T
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    return int((distances[rows[inside], columns[inside]] <= reach).sum())


def find_covered(
    scene: Scene, skin: Skin, camera: Camera, rows: Sequence[int], radius: float
) -> dict[int, Mask]:
    """The covered pixels [h,w] of the labels of every row that has any.

    ``camera`` is the whole picture's, in which landmarks are; ``radius`` of the disc in hand sizes.
    """
    everything = torch.ones(skin.count)
    suspected = [row for row in rows if _covered_of(scene, skin, camera, row, radius, everything).any()]
    if not suspected:  # the frames need not be asked what is hand
        return {}
    seen = gather(scene, skin, white_light(), ASKED_SIDE, spread(rows, ASKED))
    agreed = seen.hand / (seen.hand + seen.background).clamp_min(1e-6)
    found: dict[int, Mask] = {}
    for row in suspected:
        covered = _covered_of(scene, skin, camera, row, radius, agreed)
        labels = scene.views[row].labels
        height, width = labels.shape
        whole = cv2.resize(covered.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
        mask = (whole > 0) & (labels == BACKGROUND)
        if mask.any():
            found[row] = mask
    return found


def _covered_of(scene: Scene, skin: Skin, camera: Camera, row: int, radius: float, agreed: Tensor) -> Mask:
    """One row's covered pixels in its picture of ``SIDE``; ``agreed`` [N] in how much each surfel is hand."""
    view, level = scene.views[row], scene.views[row].level(SIDE)
    opacities = torch.full((skin.count,), START_OPACITY)
    colors = agreed.unsqueeze(-1).expand(-1, 3).contiguous()
    with torch.no_grad():
        surfels = scene.surfels(skin, row)
        out = draw(surfels.row(0), opacities, colors, level.camera, scene.raster)
        at = level.camera.project(surfels.joints)
        side, at_joints = scene.shape.model.side, torch.tensor([view.at_joints])
        marks = camera.project(tracked_points(surfels.joints, surfels.bone_rotations, side, at_joints))
    apart = (marks[0] - torch.from_numpy(view.points)).norm(dim=-1) / hand_size_pixels(marks)
    size = float(hand_size_pixels(at))
    # Averaged over the disc: what one frame hides speaks against single surfels.
    width = 2 * round(radius * size) + 1
    alpha, share = (cv2.blur(plane.numpy(), (width, width)) for plane in (out.alpha, out.rgb[..., 0]))
    return covered_pixels(
        level,
        out.alpha.numpy() > 0.5,
        np.asarray(share > CONSENSUS * alpha),
        at[0, apart > ASTRAY].numpy(),
        max(LEAST_RADIUS, radius * size),
        size,
    )


def ignoring(view: View, covered: Mask) -> View:
    """The view with its ``covered`` pixels [h,w] ignored."""
    labels = np.where(covered, IGNORE, view.labels).astype(np.uint8)
    coverage = None if view.coverage is None else np.where(covered, 0, view.coverage).astype(np.float32)
    return replace(view, labels=labels, coverage=coverage, _levels={}, _outline=None)


class CoveredMasks:
    """What is ignored in the views of ``scene`` beside what their masks ignore; kept in ``state``."""

    def __init__(self, scene: Scene, state: FitState, camera: Camera) -> None:
        self._scene, self._state, self._camera = scene, state, camera
        self._given = list(scene.views)

    def before(self, step: str, bind: Bind) -> list[int]:
        """Look anew before a ``step`` if it is one of those; the rows whose view has changed."""
        if step not in LOOKS:
            return []
        scene = replace(self._scene, views=self._given, gains=torch.ones_like(self._scene.gains))
        rows = [row for row, view in enumerate(self._given) if not view.heldout]
        found = find_covered(scene, Skin.attached(bind(1, 0, False)), self._camera, rows, LOOKS[step])
        packed = {row: torch.from_numpy(np.packbits(mask)) for row, mask in found.items()}
        before = self._state.covered
        changed = [
            row
            for row in rows
            if (row in packed) != (row in before)
            or (row in packed and not torch.equal(packed[row], before[row]))
        ]
        self._state.covered = packed
        self._apply(changed)
        pixels = sum(int(mask.sum()) for mask in found.values())
        hand = sum(int((self._given[row].labels == HAND).sum()) for row in rows)
        self._state.notes.setdefault("covered", {})[step] = {
            "frames": len(found),
            "pixels": pixels,
            "share_of_hand": round(pixels / max(hand, 1), 5),
        }
        return changed

    def take_up(self) -> None:
        """Ignore what the state says, as after loading it."""
        self._apply(list(self._state.covered))

    def _apply(self, rows: list[int]) -> None:
        for row in rows:
            view = self._given[row]
            if row in self._state.covered:
                bits = np.unpackbits(self._state.covered[row].numpy(), count=view.labels.size)
                view = ignoring(view, bits.reshape(view.labels.shape) > 0)
            self._scene.views[row] = view
