"""The hand's soft tissue as one smooth distance field."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mass_engine.hand.anatomy import STUMP, Tissue, Vector

#: How far the cut edge is rounded (metres).
_CUT = 0.010


def smooth_union(a: Vector, b: Vector, width: float) -> Vector:
    """The polynomial smooth minimum of two distances."""
    mix = np.clip(0.5 + 0.5 * (b - a) / width, 0.0, 1.0)
    return np.asarray(b * (1 - mix) + a * mix - width * mix * (1 - mix))


def tissue_distance(points: Vector, tissue: Tissue) -> Vector:
    """Approximate distance [P] of ``points`` [P,3] to one tissue, negative inside.

    Each point meets the cross-section at its place on the line; an ellipse of different heights to either
    side, closed by half ellipsoids at the ends. First-order exact at the surface.
    """
    line, sections = tissue.line, tissue.sections
    best = np.full(len(points), np.inf)
    offset, section = np.zeros_like(points), np.zeros_like(points)
    for k in range(len(line) - 1):
        step = line[k + 1] - line[k]
        place = np.clip((points - line[k]) @ step / (step @ step), 0.0, 1.0)[:, None]
        from_line = points - line[k] - place * step
        apart = (from_line * from_line).sum(1)
        nearer = apart < best
        # Cubic easing keeps the profile smooth across the sections.
        eased = place * place * (3 - 2 * place) * 0.5 + place * 0.5
        offset = np.where(nearer[:, None], from_line, offset)
        section = np.where(nearer[:, None], sections[k] + eased * (sections[k + 1] - sections[k]), section)
        best = np.where(nearer, apart, best)
    along = line[-1] - line[0]
    along = along / np.linalg.norm(along)
    back = tissue.back - along * (tissue.back @ along)
    back /= np.linalg.norm(back)
    side = np.cross(along, back)
    x, y, z = offset @ along, offset @ side, offset @ back
    height = section[:, 2] + (section[:, 1] - section[:, 2]) / (1 + np.exp(-6 * z / section[:, 1]))
    scaled = np.stack([x / tissue.tip, y / section[:, 0], z / height], 1)
    length = np.linalg.norm(scaled, axis=1)
    slope = np.linalg.norm(scaled / np.stack([np.full_like(x, tissue.tip), section[:, 0], height], 1), axis=1)
    inner = -np.minimum(section[:, 0], height)
    return np.asarray(np.where(length > 1e-3, length * (length - 1) / np.maximum(slope, 1e-9), inner))


def distance_field(points: Vector, tissues: Sequence[Tissue]) -> Vector:
    """Distance [P] of ``points`` [P,3] to the hand, negative inside, in metres."""
    palm: Vector | None = None
    for part in tissues:
        if part.group == "palm":
            here = tissue_distance(points, part)
            palm = here if palm is None else smooth_union(palm, here, part.blend)
    assert palm is not None, "a hand has a palm"
    for part in tissues:
        if part.group in ("wrist", "web"):
            palm = smooth_union(palm, tissue_distance(points, part), part.blend)
    hand = palm
    for part in tissues:
        if part.group not in ("palm", "wrist", "web"):
            digit = smooth_union(palm, tissue_distance(points, part), part.blend)
            hand = np.minimum(hand, digit)
    # Cut the forearm off, with a rounded edge.
    return -smooth_union(-hand, STUMP - points[:, 0], _CUT)


def field_gradient(points: Vector, tissues: Sequence[Tissue], step: float = 2e-4) -> Vector:
    """Gradient [P,3] of the field by central differences."""
    columns = []
    for axis in range(3):
        shift = np.zeros(3)
        shift[axis] = step
        columns.append(distance_field(points + shift, tissues) - distance_field(points - shift, tissues))
    return np.stack(columns, -1) / (2 * step)


def project(
    points: Vector, tissues: Sequence[Tissue], target: Vector | float = 0.0, steps: int = 3
) -> Vector:
    """Move ``points`` along the gradient until the field there is ``target`` (Newton)."""
    for _ in range(steps):
        slope = field_gradient(points, tissues)
        square = np.maximum((slope * slope).sum(1), 0.25)
        miss = distance_field(points, tissues) - target
        move = slope * np.clip(miss / square, -0.004, 0.004)[:, None]
        points = points - move
    return points
